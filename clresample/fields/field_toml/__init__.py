"""FIELD.toml, scene files and what they name: keys, headers, mosaics opened, sky and noise.

Imports `files`, `measurement`, `deblending` and `sky`.
"""
