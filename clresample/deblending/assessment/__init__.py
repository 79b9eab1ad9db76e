"""Assesses finished fits: residual light, light outside the frame, ambiguous sources.

Functions of a Result and of its Errors: pure NumPy, no device.
"""
