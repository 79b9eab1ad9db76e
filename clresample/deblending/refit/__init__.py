"""Second components for sources whose core has another colour, by a second fit.

Imports the rest of `deblending`, whose batch.py calls it.
"""
