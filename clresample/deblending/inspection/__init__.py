"""Inspection of observations before a fit: problems found in them, warned about, cured where safe.

NumPy and SciPy alone, no device. Thresholds follow from the noise of the images.
"""
