"""Files of surveys as mosaics: a module for each format, described in its docstring.

Imports `sky`, `files`, and of `fields` the PSFs and what is estimated from pixels; gwcs and asdf
only where a file of JWST is read.
"""
