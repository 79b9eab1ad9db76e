"""A batch of scenes on the device as AMSGrad steps it."""

from __future__ import annotations

import numpy as np

from ...deblending.solver.buffers import SceneBuffers
from .scene import AmsgradState


class AmsgradBuffers(SceneBuffers):
    """SceneBuffers of AmsgradScenes.

    latent (boxes.size,): z, laid out by the boxes; scale (S, C): of the steps of spectra
    """

    def __init__(self, scenes, states, device, dtype, prior):
        super().__init__(scenes, states, device, dtype, prior)
        self.scale = self.put(np.concatenate([s.step_scale for s in scenes]))
        self.latent = self.flat([s.latent for s in states])

    @property
    def iterated(self):
        """Device buffers that the iterations change: latent, morph, spectra, sky."""
        return self.latent, *super().iterated

    def stepped(self, iterated, memories, n_steps) -> list[AmsgradState]:
        """States of all scenes from device arrays like `iterated`, back on the host."""
        latent, *others = iterated
        parts = *self.downloaded(*others), self.unpack(self.device.get(latent)), memories
        return [
            AmsgradState(*own, latent=z, memory=memory, n_steps=n_steps)
            for *own, z, memory in zip(*parts, strict=True)
        ]
