"""The solver of the multi-scale prior: structure at several scales, their strengths, L-BFGS.

Imports the solver's own files around it, `resampling` and `device`.
"""
