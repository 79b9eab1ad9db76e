"""Code that all benchmarks share.

options   the commands' options and their one-line answers; surveys and survey pairs
clock     one thread for each side, timing by turns, worker processes
records   what a run leaves: its record, tables on the screen, JSON, a log to go on from
cases     stamps of one sky in two surveys, rendered by the operator and by GalSim
scenes    simulated blends of Euclid and Rubin, and how well they were fitted
crowded   single simulated blends of many galaxies
judged    catalogues of simulated fields beside their truth
photometry  what others measure of blended sources: matched apertures, forced profiles
runs      simulated fields run by the command, or searched alone; memory: of all its processes
truth     what a catalogue says of simulated galaxies, beside the truth and in units of its errors

Imports clresample only.
"""
