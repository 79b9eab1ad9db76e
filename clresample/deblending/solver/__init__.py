"""The solver: a batch of scenes on the device, the loss, its gradients, steps and constraints.

Knows nothing of blends, fits and results. Imports `resampling` and `device`.
"""
