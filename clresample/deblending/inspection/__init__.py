"""Inspects observations before a fit: warns of problems, and cures them where that is safe.

NumPy and SciPy alone, no device. Thresholds follow from the noise of the images.
"""
