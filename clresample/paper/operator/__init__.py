"""The paper's own scheme as a second operator: sinc tables and shifts, the yardstick in bench/.

Imports `resampling`, `sky` and `device`.
"""
