"""The solver of the multi-scale prior: structure at several scales, their strengths, L-BFGS.

Imports modules of `solver`, `resampling` and `device`.
"""
