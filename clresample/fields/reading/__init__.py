"""FIELD.toml and what it names: keys, headers, mosaics opened, sky and noise estimated.

Imports `files`, `measurement`, `deblending` and `sky`.
"""
