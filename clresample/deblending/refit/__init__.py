"""One component or two: sources whose core shows another colour are fitted once more with both.

Imports the rest of `deblending`, whose batch.py calls it.
"""
