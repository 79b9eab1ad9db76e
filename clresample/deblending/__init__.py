"""Blends to results: a scene of sources fitted to all instruments' images at once.

`batch.deblend` makes a Fit of a Blend: its observations become WhitenedViews (view.py), its sources
start from smooth profiles (start/), `iterate` runs the iterations of the package `solver/`, and the
Fit returns a Result. Imports `resampling`, `device` and `sky`.
"""
