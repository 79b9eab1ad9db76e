"""The solver: batches of scenes on the device.

A Scene and its State (scene.py) go into an Engine, which queues the loss and its gradients
(gradient.py) and the steps (amsgrad.py) with their constraints (constraints.py), and hands States
back. The model is rendered by operators.py. To try another update, give `Engine` another class in
place of AMSGrad. Knows nothing of blends, fits and results. Imports `resampling`, `device` and
`sky`.
"""
