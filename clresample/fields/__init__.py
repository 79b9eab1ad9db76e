"""Whole fields: survey mosaics of any size to one catalogue, blend by blend.

Imports `files`, `measurement`, `deblending` and `sky`.
"""
