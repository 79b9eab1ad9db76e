"""Operators in float64 between float32 images, by even and odd parts about their middles.

Imports `device` and the modules of `resampling`.
"""
