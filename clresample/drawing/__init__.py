"""Figures and cards of grids, PSFs, observations and results, for notebooks and files.

The ground floor: imports nothing of clresample's. It draws what it is handed, by its attributes;
matplotlib is imported when something is drawn.
"""
