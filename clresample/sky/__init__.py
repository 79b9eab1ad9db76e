"""Pixel grids, PSFs, images with their noise, sources. NumPy, SciPy, astropy.

The ground floor, beside `device`: imports nothing of clresample's, and never pyopencl.
"""
