"""The paper's own scheme as a second operator: sinc tables and shifts, the yardstick in bench/.

Imports `device`, `sky` and the modules of `resampling`.
"""
