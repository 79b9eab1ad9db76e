"""One observation ready to be fitted: its operator and data in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..resampling.cache import cached_resampler
from ..resampling.resampler import Resampler
from ..sky.mapping import Mapping

# Pixels of a model under this part of its brightest one count as 0 when it is rendered: of the
# model's light they hold nothing, but float32 keeps them as denormals, 20 times slower.
DARK = 1e-20


@dataclass(frozen=True, eq=False)
class WhitenedView:
    """One observation ready to be fitted: its operator and whitened data.

    op: model frame, padded where scenes share a batch -> observation, padded alike
    mapping: the op's, with the frame itself, without its padding, as the model
    covered (My, Mx): bool, whose centre lies on the frame itself
    unit (Co,) [counts]: noise of a typical pixel of each channel, in which data and model count
    root (Co, My, Mx) [1 / unit]: square root of the weights, 0 where the frame does not cover
    data (Co, My, Mx) [unit]: the observation's data
    """

    op: Resampler
    mapping: Mapping
    covered: np.ndarray
    unit: np.ndarray
    root: np.ndarray
    data: np.ndarray

    @classmethod
    def of(cls, op, frame, data, weights):
        """The view of an observation's data and weights (Co, My, Mx) on a model Frame.

        op: of the frame, or of a larger one that starts at the same pixel: what lies beyond the
            frame itself gets no weight
        """
        unit = np.array([_typical_noise(channel) for channel in weights])
        mapping = replace(op.mapping, shape_in=frame.shape)
        covered = mapping.covered
        root = np.sqrt(weights) * unit[:, None, None] * covered
        return cls(op, mapping, covered, unit, root, data / unit[:, None, None])

    @property
    def pixel_noise(self) -> np.ndarray:
        """Noise (Co,) [unit] of one model pixel, if it were observed with the same exposure."""
        area = abs(np.linalg.det(self.mapping.matrix))
        return np.full(len(self.data), 1 / np.sqrt(area))


def without_dark(images):
    """The images, in place, with DARK pixels set to 0."""
    images[np.abs(images) < DARK * np.abs(images).max(initial=0)] = 0
    return images


def whitened_view(frame, padded, observation, pad, device, dtype, *, private) -> WhitenedView:
    """The view of an Observation on a frame that is `padded`, itself padded to multiples of `pad`.

    Correlated noise is made white first (Observation.white).

    private: with an operator of its own, which may be shifted; else one that equal observations
        share
    """
    observation = observation.white
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
    data, weights = _padded(observation.data, shape), _padded(observation.weights, shape)
    return WhitenedView.of(op, frame, data, weights)


def view_as_taken(observation, view, frame, padded) -> WhitenedView:
    """The view of an Observation on a frame that is `padded`, with the observation's own PSF; where
    noise is correlated, the view has that of the white observation instead."""
    op = cached_resampler(
        padded,
        observation.grid,
        observation.psf,
        dtype=view.op.dtype,
        device=view.op.device,
        extent=frame.shape,
        private=True,
    )
    op.shift = view.op.shift
    return replace(view, op=op)


def _typical_noise(weights):
    """Median noise of the pixels that have a weight; 1 where none has."""
    seen = weights > 0
    return 1 / np.sqrt(np.median(weights[seen])) if seen.any() else 1.0


def _padded(images, shape):
    """Images (..., Ny, Nx) with zeros beyond, up to the last two of `shape`."""
    more = [(0, n - m) for n, m in zip(shape[-2:], images.shape[-2:], strict=True)]
    return np.pad(images, [(0, 0)] * (images.ndim - 2) + more)
