"""From a field's light to its blends: tiles, sources, footprints, giants cut, cutouts.

Imports `measurement`, `deblending` and `sky`.
"""
