"""The paper's own scheme as a second operator, for comparison: sinc tables and shifts.

Imports `device`, `sky` and the modules of `resampling`.
"""
