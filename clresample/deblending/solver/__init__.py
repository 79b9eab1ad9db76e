"""The solver: batches of scenes on the device.

A Scene and its State (scene.py) are uploaded (buffers.py); gradient.py has the loss and its
gradients, rendering/ the model, multiscale/ the steps, and hands States back. Knows nothing of
blends, fits and results. Imports `resampling`, `device` and `sky`.
"""
