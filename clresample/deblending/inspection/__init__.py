"""Inspects observations before a fit: warns of problems, and masks pixels if that is safe.

NumPy and SciPy alone, no device. Thresholds follow from the noise of the images.
"""
