"""Files: FITS images and results, scene files, tables, figures; each whole or absent.

Imports `measurement`, `deblending` and `sky`.
"""
