"""The operator R: a model image on another instrument's pixels and PSF, and its adjoint.

A ResamplingPlan (float64, host) holds the tables of one geometry; an executor (device) applies
them; a Resampler joins both. tiled/ applies it to whole frames, tile by tile; paper/ is the
paper's own scheme. All three operators are GridOperators. Imports `device` and `sky`.
"""
