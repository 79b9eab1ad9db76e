"""References for the posterior's errors: whole frames, every pixel's structure, float64."""

from dataclasses import dataclass

import numpy as np

from clresample.deblending.posterior import posterior as room
from clresample.deblending.posterior.modes import Modes
from clresample.deblending.posterior.normal import RIDGE, Layout, factor


@dataclass(frozen=True)
class Kept:
    """A Posterior, the views that it was made with, and their units (C,) [counts]."""

    posterior: room.Posterior
    views: list
    unit: np.ndarray

    @property
    def scaled(self):
        """Its normal matrix (N, N), of unit diagonal."""
        return self.posterior.lower @ self.posterior.lower.T


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
    """The normal matrix (N, N), of images rendered over the whole frame; scaled as `kept.scaled`.

    modes (n): other Modes than the posterior's; then not scaled
    """
    p, scene = kept.posterior, kept.posterior.solution.scene
    layout = p.layout
    if modes is not None:
        layout = Layout(np.cumsum([0, *map(len, modes)]), layout.n_channels, layout.n_sky)
    images, at = [], []
    for i, m in enumerate(modes or p.modes):
        box = tuple(
            slice(o, o + n) for o, n in zip(scene.origin[i], m.images.shape[1:], strict=True)
        )
        full = np.zeros((len(m) + 1, *scene.shape))
        full[:, *box] = np.concatenate([m.images, p.solution.morphs[i][None]])
        images.append(full)
        at.append((layout.modes(i), layout.spectrum(i)))
    matrix, channel = np.zeros((layout.size,) * 2), 0
    for view in kept.views:
        seen = [view.render(full) for full in images]
        for c in range(len(view.data)):
            j = np.zeros((layout.size, view.root[c].size))
            for i, (own, spectrum) in enumerate(at):
                j[own] = p.solution.spectra[i, channel] * seen[i][:-1, c]
                j[spectrum[channel]] = seen[i][-1, c]
            if layout.n_sky:
                j[layout.sky(channel)] = view.root[c].ravel()
            matrix += j @ j.T
            channel += 1
    for (own, _), m in zip(at, modes or p.modes, strict=True):
        matrix[np.ix_(own, own)] += m.precision
    if modes is not None:
        return matrix, layout
    return matrix / p.scale[:, None] / p.scale + RIDGE * np.eye(len(matrix))


def dense_error(kept, i):
    """Errors (C,) [counts] of component i's fluxes, the structure of every pixel unknown."""
    s = kept.posterior.solution
    modes = [_dense_modes(kept.posterior, j) for j in range(len(s.morphs))]
    matrix, layout = full_matrix(kept, modes)
    lower, scale = factor(matrix)
    slopes = np.zeros((layout.n_channels, layout.size))
    slopes[:, layout.modes(i)] = np.outer(s.spectra[i], modes[i].images.sum((1, 2)))
    slopes[:, layout.spectrum(i)] = s.morphs[i].sum() * np.eye(layout.n_channels)
    half = np.linalg.solve(lower, (slopes / scale).T)
    return np.linalg.norm(half, axis=0) * kept.unit


def _dense_modes(posterior, i):
    """Modes of component i: a normal number for each pixel, and its profile's own slopes."""
    s, n_slopes = posterior.solution, 8
    profile = s.scene.profile[i]
    n = profile.size
    covariance = 1e-9 * np.eye(n)
    for a, k in zip(s.strengths(i), s.prior.kernels(), strict=True):
        twice = np.convolve(k, k)
        rows, columns = (_toeplitz(twice, side) for side in profile.shape)
        covariance += a**2 * np.kron(rows, columns)
    root = np.linalg.cholesky(covariance).T.reshape(n, *profile.shape)
    images = s._gauged(i, np.sqrt(np.maximum(profile, 0)) * root) / s.peaks[i]
    old = posterior.modes[i]
    precision = np.diag(np.append(np.ones(n), np.diag(old.precision)[-n_slopes:]))
    return Modes(np.concatenate([images, old.images[-n_slopes:]]), precision)


def _toeplitz(taps, n):
    """(n, n) with taps[|i - j|] from the middle of `taps`, 0 beyond its ends."""
    lag = np.abs(np.arange(n)[:, None] - np.arange(n))
    half = np.append(taps[len(taps) // 2 :], 0)
    return half[np.minimum(lag, len(half) - 1)]
