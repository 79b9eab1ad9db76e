"""Frames of any size in device memory of a stated size, tile by tile.

Imports `device`, `sky` and the modules of `resampling`.
"""
