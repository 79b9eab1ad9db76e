"""One observation ready to be fitted: its operator and data in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..resampling.cache import cached_resampler
from ..resampling.resampler import Resampler

# Light this far under the brightest is none: float32 would keep it as denormals, 20 times slower.
DARK = 1e-20


@dataclass(frozen=True, eq=False)
class WhitenedView:
    """One observation ready to be fitted: its operator and whitened data.

    op: model frame -> observation
    root (Co, My, Mx): square root of the weights, 0 where the model does not cover
    data (Co, My, Mx): the observation's data
    """

    op: Resampler
    root: np.ndarray
    data: np.ndarray

    def observe(self, images):
        """Unit-spectrum images (n, Co, My, Mx) of model images (n, Ny, Nx).

        Images smaller than the operator's frame are zero beyond.
        """
        images = _padded(images, self.op.shape_in).astype(self.op.dtype)
        images[np.abs(images) < DARK * np.abs(images).max(initial=0)] = 0
        return self.op.render(images)

    def whiten(self, observed):
        """Observed images in units of their noise, (n, Co, My * Mx)."""
        out = observed * self.root
        return out.reshape(*out.shape[:2], -1).astype(np.float64)

    def render(self, images):
        """Whitened unit-spectrum images (n, Co, My * Mx) of model images (n, Ny, Nx)."""
        return self.whiten(self.observe(images))


def _padded(images, shape):
    """Images (..., Ny, Nx) with zeros beyond, up to the last two of `shape`."""
    more = [(0, n - m) for n, m in zip(shape[-2:], images.shape[-2:], strict=True)]
    return np.pad(images, [(0, 0)] * (images.ndim - 2) + more)


def whitened_view(frame, padded, observation, pad, device, dtype, *, private):
    """An observation in units of its channels' noise, padded, and these units (Co,).

    Pixels beyond the frame itself have no weight, though they may lie on the padded one.
    """
    shape = tuple(-(-n // pad) * pad for n in observation.data.shape[1:])
    grid = observation.grid
    if shape != observation.data.shape[1:]:
        grid = grid.cutout(0, 0, shape)
    op = cached_resampler(
        padded,
        grid,
        observation.psf,
        dtype=dtype,
        device=device,
        extent=frame.shape,
        private=private,
    )
    low = [(0, 0)] + [(0, n - m) for n, m in zip(shape, observation.data.shape[1:], strict=True)]
    data, weights = np.pad(observation.data, low), np.pad(observation.weights, low)
    seen = weights > 0
    unit = np.array(
        [
            1 / np.sqrt(np.median(w[s])) if s.any() else 1.0
            for w, s in zip(weights, seen, strict=True)
        ]
    )
    root = np.sqrt(weights) * unit[:, None, None] * covered_part(op, frame)
    return WhitenedView(op, root, data / unit[:, None, None]), unit


def covered_part(op, frame):
    """Observed pixels (My, Mx) whose centre lies on the frame itself, not on its padding."""
    return replace(op.mapping, shape_in=frame.shape).covered


def pixel_noise(views):
    """Noise (C,) of one model pixel per channel, in the views' units."""
    noise = []
    for view in views:
        area = abs(np.linalg.det(view.op.mapping.matrix))
        noise += [1 / np.sqrt(area)] * view.data.shape[0]
    return np.array(noise)
