"""What a Result keeps of its posterior: covariances, maps, and what draws are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one blend's sources, marginal over morphologies, neighbours and a fitted sky.

    S sources, C channels of all observations, n components.

    flux (C, S, S) [counts^2]: covariance of the fluxes of one channel, Settings.flux_floor included
    colour (S, C, C) [counts^2]: covariance of one source's fluxes; the floor is common to all its
        channels, so that it does not enter ratios of fluxes
    moments (S, 5, 5) [px, px^2]: covariance of a source's centroid (y, x) and second moments
        (yy, yx, xx), its components weighted by their light as in the catalogue; NaN of what was
        not fitted: all of stars at a given place, the second moments of free ones
    morphology (n): arrays (ny, nx) [1]: standard deviation of each component's morphology, at a
        fixed projection onto its smooth profile
    """

    flux: np.ndarray
    colour: np.ndarray
    moments: np.ndarray
    morphology: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Draws:
    """What draws from the posterior are made of.

    modes (n): (k_i, ny, nx), images of each component's modes
    lower (N, N), scale (N,): H = (scale lower) (scale lower)^T over all modes' coefficients, then
        the spectra (n, C), then the sky levels
    unit (C,) [counts]: in which spectra count there
    """

    modes: list[np.ndarray]
    lower: np.ndarray
    scale: np.ndarray
    unit: np.ndarray

    def draw(self, rng):
        """Changes of the morphologies (n arrays) and of the spectra (n, C) [counts]."""
        normal = rng.standard_normal(len(self.scale))
        values = np.linalg.solve(self.lower.T, normal) / self.scale
        ends = np.cumsum([0, *(len(m) for m in self.modes)])
        pairs = zip(self.modes, ends, strict=False)
        morphs = [np.tensordot(values[at : at + len(m)], m, 1) for m, at in pairs]
        n, n_channels = len(self.modes), len(self.unit)
        spectra = values[ends[-1] : ends[-1] + n * n_channels].reshape(n, n_channels)
        return morphs, spectra * self.unit
