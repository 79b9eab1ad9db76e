"""Images of single sources of a fitted blend without their neighbours.

separation.py divides a window of an observation between sources; deviations.py computes the error
of the models there; window.py selects the rows and columns that hold a source; choice.py resolves
names of sources and observations; cutout.py implements `Result.cutout`. The package imports
adapters, resampling and sky.
"""
