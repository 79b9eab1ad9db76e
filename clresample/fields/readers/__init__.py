"""Files of surveys as mosaics, a module for each format; its docstring says what is read.

Imports `sky`, `files`, and of `fields` the PSFs and what is estimated from pixels; gwcs and asdf
only where a file of JWST is read.
"""
