"""The solver of the prior that learns: structure at several scales, their strengths, L-BFGS.

Imports the solver's own files around it, `resampling` and `device`.
"""
