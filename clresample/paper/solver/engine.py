"""Runs a batch of scenes on the device: gradients and steps in turn; stores the best state."""

from __future__ import annotations

import numpy as np

from ...deblending.solver.gradient import LossGradient
from .amsgrad import AMSGrad, StepSizes
from .buffers import AmsgradBuffers
from .constraints import ProxChain
from .prior import SingleScalePrior
from .scene import AmsgradScene, AmsgradState

# Largest number of iterations of one `run`: their losses stay on the device until they are read.
MAX_STEPS = 16
# Index of an additional loss; best states belong to the losses of a run.
LAST = MAX_STEPS - 1


class AmsgradLoss(LossGradient):
    """The loss of a batch and its gradients, with the prior's term 1/2 |z|^2 in the loss.

    with_prior: whether the loss has that term; the gradient has it where z is stepped (amsgrad.py)
    best (B,): lowest loss of each scene among those computed with i_loss = 0, infinite before
    """

    def __init__(self, buffers, with_prior, depth=None):
        super().__init__(buffers, depth)
        b, group = buffers, buffers.tuning.sum_group
        self.best = b.put(np.full(len(b.scenes), np.inf))
        self._losses = b.launcher("losses.cl", "losses", 2, local_size=(group, 1)).bind(
            first=b.first,
            table=b.boxes.table,
            n_rows=self.rows[-1],
            rows=self.rows_loss,
            prior=with_prior,
            latent=b.latent,
            best=self.best,
        )

    def __call__(self, losses, i_loss):
        """Queues the evaluation; writes the scenes' losses to row i_loss of losses (n, B)."""
        self.queue()
        self._losses((self.buffers.tuning.sum_group, len(self.best)), out=losses, i_loss=i_loss)


class Engine:
    """A batch of scenes of one signature on the device.

    scenes, states: of the scenes, all after the same number of iterations
    chain: constraints on the morphologies, applied after every step
    prior: the SingleScalePrior of all extended sources, or None to fit the morphologies themselves
    step_sizes: the StepSizes; update: what steps, a class like AMSGrad

    buffers, update: the batch's AmsgradBuffers and its update, with the present state
    """

    def __init__(
        self,
        scenes: list[AmsgradScene],
        states: list[AmsgradState],
        device,
        dtype,
        *,
        chain: ProxChain,
        prior: SingleScalePrior | None,
        step_sizes: StepSizes,
        update=AMSGrad,
    ):
        self.scenes, self.device = scenes, device
        b = self.buffers = AmsgradBuffers(scenes, states, device, dtype, prior)
        self._gradient = AmsgradLoss(b, with_prior=prior is not None)
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

    def states(self, *, kept=False) -> list[AmsgradState]:
        """The scenes' present states, or the best ones kept, back on the host."""
        iterated = self._kept if kept else self.buffers.iterated
        return self.buffers.stepped(iterated, self.update.memories(), self.n_steps)

    def update_shifts(self):
        """Copies the current shifts of the scenes' operators."""
        self._gradient.update_shifts()
