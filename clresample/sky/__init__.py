"""Pixel grids, PSFs, images with their noise, sources. NumPy, SciPy, astropy.

The lowest layer, beside `device`: imports only `drawing` of clresample, and never pyopencl.
"""
