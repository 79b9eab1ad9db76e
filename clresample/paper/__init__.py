"""The paper's own methods, to compare with: its operator, and its solver with constraints.

Imports `deblending`, `resampling`, `sky` and `device`.
"""
