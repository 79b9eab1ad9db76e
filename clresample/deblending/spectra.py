"""Spectra of known morphologies: non-negative least squares over all sources at once."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

# Error of a smooth profile, as a part of the light in a pixel: what galaxies' own structure, spiral
# arms or clumps, adds to it. Larger values let faint neighbours absorb less of that structure, and
# make bright sources count for less.
MODEL_ERROR = 0.15
# Added to the diagonal of the normal matrix, which is scaled to a diagonal of 1. Without it the
# matrix of two sources with equal profiles, two stars in one place, is singular; with it they get
# equal parts of their light. It changes the flux of a source apart from others by this part of it;
# a larger one would share light between neighbours that the data can tell apart.
RIDGE = 1e-8


def solve_spectra(units, views, sky=False, model=None):
    """Non-negative spectra (n, C) by weighted least squares over all components at once.

    units: per view, whitened unit-spectrum images (n, Co, P); sky: also a constant per channel
    model: per view (Co, P) whitened, inflates the variance by (MODEL_ERROR model)^2
    returns spectra (n, C), sky (C,), covariance (C, n, n): inverse normal matrix, sky marginalised
    """
    spectra, levels, covariances = [], [], []
    for i, (view, unit) in enumerate(zip(views, units, strict=True)):
        for c in range(unit.shape[1]):
            rows = unit[:, c]
            target = (view.data[c] * view.root[c]).ravel()
            if sky:
                rows = np.concatenate([rows, [view.root[c].ravel()]])
            weight = 1.0 if model is None else 1 / (1 + (MODEL_ERROR * model[i][c]) ** 2)
            a, covariance = _non_negative(rows, target, weight, n_free=int(sky))
            spectra.append(a[: len(unit)])
            levels.append(a[-1] if sky else 0.0)
            covariances.append(covariance[: len(unit), : len(unit)])
    return np.array(spectra).T, np.array(levels), np.array(covariances)


def _non_negative(rows, target, weight, n_free=0):
    """min |target - a rows|^2, a >= 0 but for the last n_free; and a's unconstrained covariance."""
    normal = (rows * weight) @ rows.T
    size = np.sqrt(np.diag(normal))
    seen = size > 1e-12 * size.max(initial=0)
    scale = np.where(seen, size, 1)
    normal = normal / scale[:, None] / scale + RIDGE * np.eye(len(rows))
    lower = np.linalg.cholesky(normal)
    right = np.linalg.solve(lower, (rows * weight) @ target / scale)
    matrix = lower.T
    if n_free:  # a free coefficient is the difference of two non-negative ones
        matrix = np.concatenate([matrix, -matrix[:, -n_free:]], axis=1)
    a = nnls(matrix, right)[0]
    if n_free:
        a = np.concatenate([a[: -2 * n_free], a[-2 * n_free : -n_free] - a[-n_free:]])
    covariance = np.linalg.inv(normal) / scale[:, None] / scale
    covariance[~seen, :] = covariance[:, ~seen] = 0
    covariance[~seen, ~seen] = np.inf
    return np.where(seen, a / scale, 0), covariance
