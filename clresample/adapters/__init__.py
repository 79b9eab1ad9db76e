"""Optional bridges to GalSim, JAX, PyTorch, scarlet2, astropy and photutils.

A module here has the name of the package that it needs, which is imported where it is used, with
one line that says what to install. Nothing else of clresample imports these packages.
"""
