"""From a field's images to its blends: tiles, sources, footprints, cuts, cutouts.

Imports `measurement`, `deblending` and `sky`.
"""
