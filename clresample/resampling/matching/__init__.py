"""Maps images of several instruments onto one grid and one PSF, with their noise.

match.py has the call `match`; kernel.py propagates the noise; target.py chooses the grid and PSF.
The package imports sky and the operator.
"""
