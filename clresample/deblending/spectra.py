"""Spectra of known morphologies: non-negative least squares over all sources at once."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from .profiles import point

# Error of a smooth profile, as a part of the light in a pixel: what galaxies' own structure, spiral
# arms or clumps, adds to it. Larger values let faint neighbours absorb less of that structure, and
# make bright sources count for less.
MODEL_ERROR = 0.15
# Added to the diagonal of the normal matrix, which is scaled to a diagonal of 1. Without it the
# matrix of two sources with equal profiles, two stars in one place, is singular; with it they get
# equal parts of their light. It changes the flux of a source apart from others by this part of it;
# a larger one would share light between neighbours that the data can tell apart.
RIDGE = 1e-8
# Times that the weights follow the point sources' light: once with the weights of the noise alone,
# where a wrong PSF draws neighbours into a bright star's misfit, and once with the first ones.
ROUNDS = 2
# [sigma] Point sources whose PSF's error is nowhere more than this leave the weights as they are.
FAINT = 0.05


def allow_for_psf_error(views, start, psf_error, sky=False):
    """Views whose weights hold the error of the PSF in the light of bright point sources.

        1/w = sigma^2 + psf_error^2 sum_s [ L_s^2 + (r . grad L_s)^2 ],      L_s = A_s R S_s

    over the point sources s, r being the distance from s: L changes by -(2 L + r . grad L) epsilon
    when the PSF grows by epsilon, so that its wings are less certain than its core. The spectra
    are solved for beside all others', ROUNDS times; from then on the weights stay as they are.

    start: StartingPoint; psf_error: see Settings; sky: whether levels are fitted too
    """
    points = start.points
    if not psf_error or not points.any():
        return views
    observed, allowing = [view.observe(start.profiles) for view in views], views
    for _ in range(ROUNDS):
        units = [view.whiten(o) for view, o in zip(allowing, observed, strict=True)]
        spectra = solve_spectra(units, allowing, sky)[0]
        parts = np.split(spectra, np.cumsum([o.shape[1] for o in observed])[:-1], axis=1)
        light = [a[:, :, None, None] * o for a, o in zip(parts, observed, strict=True)]
        bright = np.flatnonzero(points & _bright(views, light, psf_error))
        if not len(bright):
            return views
        squares = [np.square(images[bright], dtype=np.float64).sum(axis=0) for images in light]
        for i in bright:
            changes = _changes_with_width(start.shapes[i], start.positions[start.source[i]], views)
            for total, change, a in zip(squares, changes, parts, strict=True):
                total += (a[i, :, None, None] * change) ** 2
        allowing = [
            view.allowing(psf_error * np.sqrt(total))
            for view, total in zip(views, squares, strict=True)
        ]
    return allowing


def _bright(views, light, psf_error):
    """Which components (n,) are bright enough for the PSF's error; light: per view (n, ...)."""
    most = [
        np.abs(images * view.root).max(axis=(1, 2, 3))
        for view, images in zip(views, light, strict=True)
    ]
    return psf_error * np.max(most, axis=0) > FAINT


def _changes_with_width(star, position, views):
    """r . grad L (Co, My, Mx) per view, of a Star of unit flux at a position (2,) [model px]."""
    slopes = point(star.psf, position, star.shape)[1:]  # by the position: minus the gradient
    for view in views:
        n, m = np.indices(view.mapping.shape_out)
        away = view.mapping.at(n, m) + view.op.shift - position
        yield np.einsum("acyx,yxa->cyx", view.observe(slopes), away)


def solve_spectra(units, views, sky=False, errors=None):
    """Non-negative spectra (n, C) by weighted least squares over all components at once.

    units: per view, whitened unit-spectrum images (n, Co, P); sky: also a constant per channel
    errors: per view (Co, P) whitened, of the model, whose squares add to the variance
    returns spectra (n, C), sky (C,), covariance (C, n, n): inverse normal matrix, sky marginalised
    """
    spectra, levels, covariances = [], [], []
    for i, (view, unit) in enumerate(zip(views, units, strict=True)):
        for c in range(unit.shape[1]):
            rows = unit[:, c]
            target = (view.data[c] * view.root[c]).ravel()
            if sky:
                rows = np.concatenate([rows, [view.root[c].ravel()]])
            weight = 1.0 if errors is None else 1 / (1 + errors[i][c] ** 2)
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
