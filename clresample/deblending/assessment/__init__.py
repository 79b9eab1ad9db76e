"""Judges finished fits: what models leave in the data, light outside the frame, divided light.

Functions of a Result and of its Errors: pure NumPy, no device.
"""
