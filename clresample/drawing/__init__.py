"""Figures and cards of grids, PSFs, observations and results, for notebooks and files.

The lowest layer: imports no other package of clresample. Objects are drawn by their attributes;
matplotlib is imported when something is drawn.
"""
