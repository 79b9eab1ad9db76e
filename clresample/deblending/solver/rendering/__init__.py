"""Renders the sources of a batch in each observation, by the cheapest of four methods.

Spectra are applied to morphologies as they are, or after they were transformed, each in its box, in
whole frames or in windows of neighbouring sources.

Modules here may import `device`, `resampling` and modules of the solver, which calls them.
"""
