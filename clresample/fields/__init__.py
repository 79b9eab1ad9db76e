"""Whole fields: survey mosaics of any size to one catalogue, blend by blend, losing none.

Imports `files`, `measurement`, `deblending` and `sky`.
"""
