"""The paper's solver: proximal AMSGrad of the scenes of deblending/solver, under constraints.

An AmsgradScene and its AmsgradState (scene.py) go into an Engine, which queues the loss with its
gradients, and the steps (amsgrad.py) with their constraints (constraints.py), and hands
AmsgradStates back. To try another update, give `Engine` another class in place of AMSGrad. Imports
`deblending`'s solver, `device` and `sky`.
"""
