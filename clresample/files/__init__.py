"""Files: FITS images and results, scene files, tables, figures; all written atomically.

Imports `measurement`, `deblending` and `sky`.
"""
