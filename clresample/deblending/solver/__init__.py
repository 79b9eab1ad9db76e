"""The solver: batches of scenes on the device.

A Scene and its State (scene.py) go into an Engine, which queues the loss and its gradients
(gradient.py) and the steps (amsgrad.py) with their constraints (constraints.py), and returns
States. rendering/ renders the model. To try another update, pass `Engine` another class in place of
AMSGrad. This package does not depend on blends, fits and results. Imports `resampling`, `device`
and `sky`.
"""
