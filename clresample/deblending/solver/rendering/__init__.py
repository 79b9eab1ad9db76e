"""What each observation is shown of the sources: spectra applied to morphologies as they are, or
after they were transformed, each in its box, in whole frames or in windows of neighbouring sources,
whichever takes the device least.

Modules here may import `device`, `resampling` and the solver's own; they are asked by solver/.
"""
