"""Runs a batch of scenes on the device: gradients and steps in turn; stores the best state."""

from __future__ import annotations

import numpy as np

from .amsgrad import AMSGrad, StepSizes
from .buffers import SceneBuffers
from .constraints import ProxChain
from .gradient import LossGradient
from .prior import SingleScalePrior
from .scene import Scene, State

# Largest number of iterations of one `run`: their losses stay on the device until they are read.
MAX_STEPS = 16
# Index of an additional loss; best states belong to the losses of a run.
LAST = MAX_STEPS - 1


class Engine:
    """A batch of scenes of one signature on the device.

    scenes, states: of the scenes, all after the same number of iterations
    chain: constraints on the morphologies, applied after every step
    prior: the SingleScalePrior of all extended sources, or None to fit the morphologies themselves
    step_sizes: the StepSizes; update: what steps, a class like AMSGrad

    buffers, update: the batch's SceneBuffers and its update, with the present state
    """

    def __init__(
        self,
        scenes: list[Scene],
        states: list[State],
        device,
        dtype,
        *,
        chain: ProxChain,
        prior: SingleScalePrior | None,
        step_sizes: StepSizes,
        update=AMSGrad,
    ):
        self.scenes, self.device = scenes, device
        b = self.buffers = SceneBuffers(scenes, states, device, dtype, prior)
        self._gradient = LossGradient(b, with_prior=prior is not None)
        self.update = update(
            b, self._gradient, states, chain=chain, prior=prior, step_sizes=step_sizes
        )
        self.losses = device.empty((MAX_STEPS, len(scenes)), b.dtype)
        self._kept = [device.put(device.get(a)) for a in b.iterated]
        self._keep_size = b.box_rows(b.n_sources)
        names = "latent", "morph", "spectra", "sky"
        self._keep = b.launcher("losses.cl", "keep_best", 3).bind(
            active=b.boxes.everyone,
            table=b.boxes.table,
            first=b.first,
            n_channels=b.n_channels,
            loss=self.losses,
            best=self._gradient.best,
            **dict(zip(names, b.iterated, strict=True)),
            **{f"kept_{name}": array for name, array in zip(names, self._kept, strict=True)},
        )

    @property
    def n_steps(self) -> int:
        """Iterations done so far, those before this engine was made among them."""
        return self.update.n_steps

    def run(self, n_steps):
        """Losses (n_steps, B) before each of `n_steps` iterations, which it runs.

        The state before the first of them is kept for each scene whose loss is the lowest so far.
        """
        if n_steps > MAX_STEPS:
            raise ValueError(f"n_steps is {n_steps}, one run does at most {MAX_STEPS}")
        for i in range(n_steps):
            self.gradient(i)
            if i == 0:
                self._keep(self._keep_size)
            self.step()
        return self.device.get(self.losses)[:n_steps].astype(np.float64)

    def gradient(self, i_loss=0):
        """Queues model, residual, gradients, and the losses into losses[i_loss]."""
        self._gradient(self.losses, i_loss)

    def step(self):
        """Queues one step of the update along the gradients."""
        self.update.step()

    def final_losses(self):
        """Losses (B,) at the present state."""
        self.gradient(LAST)
        return self.device.get(self.losses)[LAST].astype(np.float64)

    def best_losses(self):
        """Losses (B,) of the states kept, infinite before the first iteration."""
        return self.device.get(self._gradient.best).astype(np.float64)

    def states(self, *, kept=False) -> list[State]:
        """The scenes' present states, or the best ones kept, back on the host."""
        iterated = self._kept if kept else self.buffers.iterated
        return self.buffers.states(iterated, self.update.memories(), self.n_steps)

    def update_shifts(self):
        """Copies the current shifts of the scenes' operators."""
        self._gradient.update_shifts()
