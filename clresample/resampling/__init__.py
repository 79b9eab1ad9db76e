"""The operator R: a model image on another instrument's pixels and PSF, and its adjoint.

A ResamplingPlan (float64, host) holds the tables of one geometry; an executor (device) applies
them; a Resampler joins both. tiled/ takes whole frames through it, paper/ is the paper's own
scheme beside it, and all three are GridOperators. Imports `device` and `sky`.
"""
