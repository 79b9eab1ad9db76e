"""FIELD.toml, scene files and their files: keys, headers, mosaics, sky and noise.

Imports `files`, `measurement`, `deblending` and `sky`.
"""
