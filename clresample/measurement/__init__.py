"""Detections before a fit; fluxes, shapes, chi2 and the catalogue after it.

Imports `deblending`, `resampling` and `sky`.
"""
