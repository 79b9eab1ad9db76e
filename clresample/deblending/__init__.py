"""Blends to results: a scene of sources fitted to all instruments' images at once.

From `batch.deblend` a blend goes through a Fit (views of its observations, starting profiles, the
iterations of `solver`) to a Result. Imports `resampling`, `device` and `sky`.
"""
