"""The source-to-distortion ratio, the paper's measure of a model's accuracy."""

from __future__ import annotations

import numpy as np


def sdr(truth, estimate, *, unit_sum=False):
    """Source-to-distortion ratio, without a square, over the last two axes.

        SDR = 10 log10( |X| / |X~ - X| )

    truth (..., Ny, Nx), estimate (..., Ny, Nx): X and X~
    unit_sum: divide each image by its sum first; one whose sum is 0 stays as it is
    returns (...) [dB]: infinite where both are equal, 0 for an estimate without light

    Raises ValueError for shapes that differ. Source: section `Sect:accuracy`.
    """
    truth, estimate = np.asarray(truth, float), np.asarray(estimate, float)
    if truth.shape != estimate.shape:
        raise ValueError(f"estimate has shape {estimate.shape}, truth has {truth.shape}")
    if unit_sum:
        truth, estimate = _unit_sum(truth), _unit_sum(estimate)
    error = np.linalg.norm(estimate - truth, axis=(-2, -1))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(np.linalg.norm(truth, axis=(-2, -1)) / error)


def _unit_sum(images):
    total = images.sum(axis=(-2, -1), keepdims=True)
    return images / np.where(total == 0, 1, total)
