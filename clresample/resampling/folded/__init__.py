"""Operators between images that are even and odd parts about their middles, inside in float64.

Imports `device` and the modules of `resampling`.
"""
