"""Images of several instruments on one grid and under one PSF, with their noise.

match.py: the call; kernel.py: the noise of the result; target.py: which grid and PSF. They
import sky and the operator.
"""
