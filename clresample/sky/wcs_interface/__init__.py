"""WCS objects of other packages (gwcs, AST), through the interface of astropy's proposal 14.

Imports NumPy and astropy only.
"""
