"""The solver: batches of scenes on the device.

A Scene and its State (scene.py) are uploaded (buffers.py); gradient.py queues the loss and its
gradients, rendering/ renders the model, and multiscale/ takes the steps and returns States. This
package does not depend on blends, fits and results. Imports `linear`, `resampling`, `device` and
`sky`.
"""
