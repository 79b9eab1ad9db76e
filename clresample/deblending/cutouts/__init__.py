"""Cutouts of single sources of a fitted blend: images of one source without its neighbours.

separation.py: arrays on a window of an observation; deviations.py: the error of the models there;
window.py: rows and columns that hold a source; cutout.py: what `Result.cutout` returns. They import
adapters, resampling and sky.
"""
