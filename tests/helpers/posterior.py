"""References for the posterior's errors: whole frames, every pixel's structure, float64."""

from dataclasses import dataclass

import numpy as np

from clresample.deblending.linear.block_matrix import RIDGE
from clresample.deblending.linear.normal import SCATTER_PX, UnknownLayout
from clresample.deblending.posterior import posterior as room

from .start import rendered


@dataclass(frozen=True)
class Kept:
    """A Posterior, the views that it was made with, and their units (C,) [counts]."""

    posterior: room.Posterior
    views: list
    unit: np.ndarray

    @property
    def matrix(self):
        """Its normal matrix (N, N), node after node."""
        return self.posterior.matrix.dense()


def scaled(matrix):
    """A matrix with a diagonal of 1."""
    scale = np.sqrt(np.diag(matrix))
    return matrix / scale[:, None] / scale


def capture(monkeypatch):
    """A list to which every posterior that is made from now on is added, as Kept."""
    kept, made = [], room.posterior_of

    def posterior_of(fit, *given):
        found = made(fit, *given)
        kept.append(Kept(found[0], fit.views, fit.unit))
        return found

    monkeypatch.setattr(room, "posterior_of", posterior_of)
    return kept


def full_matrix(kept, modes=None):
    """The normal matrix (N, N), of images rendered over the whole frame, node after node.

    modes (n): other modes than the posterior's
    """
    p, scene = kept.posterior, kept.posterior.solution.scene
    modes = modes or p.modes
    layout = UnknownLayout(np.array([len(m) for m in modes]), *list(vars(p.layout).values())[1:])
    starts = np.cumsum([0, *layout.sizes])
    n_common = layout.n_sky + layout.n_shifts
    images = []
    for i, m in enumerate(modes):
        box = tuple(slice(o, o + n) for o, n in zip(scene.origin[i], m.shape[1:], strict=True))
        full = np.zeros((len(m) + 3, *scene.shape))
        full[:-2, *box] = np.concatenate([m, p.solution.morphs[i][None]])
        full[-2:] = np.gradient(full[-3])
        images.append(full)
    matrix, channel = np.zeros((starts[-1] if n_common else starts[len(modes)],) * 2), 0
    for o, view in enumerate(kept.views):
        seen = [rendered(view, full) for full in images]
        for c in range(len(view.data)):
            j = np.zeros((len(matrix), view.sqrt_weights[c].size))
            for i, at in enumerate(starts[: len(modes)]):
                k = len(modes[i])
                j[at : at + k] = p.solution.spectra[i, channel] * seen[i][:-3, c]
                j[at + k + channel] = seen[i][-3, c]
                if layout.n_shifts and o:
                    to = starts[len(modes)] + layout.n_sky + 2 * (o - 1)
                    j[to : to + 2] += p.solution.spectra[i, channel] * seen[i][-2:, c]
            if layout.n_sky:
                j[starts[len(modes)] + channel] = view.sqrt_weights[c].ravel()
            matrix += j @ j.T
            channel += 1
    for at, m in zip(starts, modes, strict=False):
        matrix[at : at + len(m), at : at + len(m)] += np.eye(len(m))
    for c, known in enumerate(scene.known_sky[: layout.n_sky]):
        matrix[starts[len(modes)] + c, starts[len(modes)] + c] += known
    if layout.n_shifts:
        matrix[-layout.n_shifts :, -layout.n_shifts :] += np.eye(layout.n_shifts) / SCATTER_PX**2
    return matrix


def dense_error(kept, i):
    """Errors (C,) [counts] of component i's fluxes, the structure of every pixel unknown."""
    s = kept.posterior.solution
    found = [_dense_modes(kept.posterior, j) for j in range(len(s.morphs))]
    modes, beyond = [m for m, _ in found], found[i][1]
    matrix, n_channels = full_matrix(kept, modes), len(kept.unit)
    at = sum(len(m) + n_channels for m in modes[:i])
    slopes = np.zeros((n_channels, len(matrix)))
    total = s.morphs[i].sum() + kept.posterior.beyond[i][0, 0]
    k = len(modes[i])
    slopes[:, at : at + k] = np.outer(s.spectra[i], modes[i].sum((1, 2)) + beyond)
    slopes[:, at + k : at + k + n_channels] = total * np.eye(n_channels)
    scale = np.sqrt(np.diag(matrix))
    lower = np.linalg.cholesky(scaled(matrix) + RIDGE * np.eye(len(matrix)))
    half = np.linalg.solve(lower, (slopes / scale).T)
    return np.linalg.norm(half, axis=0) * kept.unit


def _dense_modes(posterior, i):
    """Modes of component i: a normal number for each pixel, and its profile's own slopes.

    Returns also the change of the light beyond its box by each (k,).
    """
    s, n_slopes = posterior.solution, 8
    profile = s.scene.profile[i]
    n = profile.size
    covariance = 1e-9 * np.eye(n)
    for a, k in zip(s.strengths(i), s.prior.kernels(), strict=True):
        twice = np.convolve(k, k)
        rows, columns = (_toeplitz(twice, side) for side in profile.shape)
        covariance += a**2 * np.kron(rows, columns)
    root = np.linalg.cholesky(covariance).T.reshape(n, *profile.shape)
    images = np.sqrt(np.maximum(profile, 0)) * root
    along = s.along(i, images)
    far = posterior.beyond[i]
    beyond = np.concatenate([-far[0, 0] * along, far[0, -n_slopes:]])
    return np.concatenate([images / s.peaks[i], posterior.modes[i][-n_slopes:]]), beyond


def _toeplitz(taps, n):
    """(n, n) with taps[|i - j|] from the middle of `taps`, 0 beyond its ends."""
    lag = np.abs(np.arange(n)[:, None] - np.arange(n))
    half = np.append(taps[len(taps) // 2 :], 0)
    return half[np.minimum(lag, len(half) - 1)]
