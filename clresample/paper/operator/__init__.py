"""The paper's own scheme as a second operator, for comparison: sinc tables and shifts.

Imports `resampling`, `sky` and `device`.
"""
