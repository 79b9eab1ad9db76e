"""The covariances, error maps and posterior sampler that a Result stores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..solver.rendering.ties import Ties
from .block_matrix import BlockCholesky

# Number of draws for the errors of cutouts, and their seed. Standard deviations have a relative
# error of 1 / sqrt(2 N) = 0.09; the time is proportional to the number.
N_SAMPLES, SEED = 64, 0


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a blend's sources, marginalised over shapes, neighbours, fitted sky and shifts.

    S sources, C channels of all observations, n components. All errors of a misfitted source are
    multiplied by one factor, see `residuals.misfit_error_scale`; its covariances by both factors.

    flux (C, S, S) [counts^2]: covariance of the fluxes of one channel, Settings.flux_error_floor
        included; 0 between sources that do not overlap, without the effect of a common sky or shift
    colour (S, C, C) [counts^2]: covariance of one source's fluxes; the floor is common to all its
        channels, so that it does not enter ratios of fluxes
    moments (S, 5, 5) [px, px^2]: covariance of a source's centroid (y, x) and second moments
        (yy, yx, xx), its components weighted by their light as in the catalogue; NaN if not fitted:
        all for stars at a fixed position, the second moments for free ones
    morphology (n): arrays (ny, nx) [1]: standard deviation of each component's morphology, at a
        fixed projection onto its smooth profile
    outside_box_moments (n, 6) [1, px, px^2]: a contribution to fluxes and moments, not an error:
        the sums of each component's smooth profile beyond its box, times 1, y, x, y y, y x, x x of
        the frame, if the morphology has its maximum 1
    flux_bound_bias (S, C) [counts], moment_bound_bias (S, 5) [px, px^2]: corrections, not errors:
        the changes of fluxes, and of centroids and second moments, without the bound of
        morphologies at 0, see bound_bias.py; 0 for second moments of stars
    residuals (S, C) [sigma]: the largest on each source, see `channel_residuals`
    outside (S, C) [counts]: flux of the models outside the observed area, see `light_outside`; its
        square is included in `flux` and `colour`. 0 by default
    """

    flux: np.ndarray
    colour: np.ndarray
    moments: np.ndarray
    morphology: tuple[np.ndarray, ...]
    outside_box_moments: np.ndarray
    flux_bound_bias: np.ndarray
    moment_bound_bias: np.ndarray
    residuals: np.ndarray
    outside: np.ndarray | None = None

    def __post_init__(self):
        if self.outside is None:
            object.__setattr__(self, "outside", np.zeros(np.shape(self.flux_bound_bias)))


@dataclass(frozen=True, eq=False)
class PosteriorSampler:
    """Means and factors from which samples of the posterior are drawn.

    modes (n): (k_i, ny, nx), images of each component's modes
    factor: of the normal matrix, whose node i is component i, its modes and then its spectrum (B,)
    unit (C,) [counts]: unit of the spectra there
    misfit_scale (n,): factor of the scatter of misfitted sources' components, as for their Errors
    ties: Ties of the channels, of B bands; None: B = C
    """

    modes: list[np.ndarray]
    factor: BlockCholesky
    unit: np.ndarray
    misfit_scale: np.ndarray
    ties: Ties | None = None

    @cached_property
    def samples(self) -> list[np.ndarray]:
        """Draws (N_SAMPLES, k_i + B) of each node's unknowns, always the same ones."""
        rng, size = np.random.default_rng(SEED), sum(self.factor.sizes)
        found = [self.factor.draw(rng.standard_normal(size)) for _ in range(N_SAMPLES)]
        return [np.array(rows) for rows in zip(*found, strict=True)]

    def changes(self, i):
        """Sampled changes of component i: of its morphology and of its spectrum [counts].

        returns (N_SAMPLES, ny, nx) and (N_SAMPLES, C)
        """
        images, values = self.modes[i], self.misfit_scale[i] * self.samples[i]
        morphs = np.tensordot(values[:, : len(images)], images, 1)
        return morphs, self._spectra(values[:, len(images) :])

    def draw(self, rng):
        """Changes of the morphologies (n arrays) and of the spectra (n, C) [counts]."""
        found = self.factor.draw(rng.standard_normal(sum(self.factor.sizes)))
        morphs, spectra = [], []
        for values, images, wide in zip(found, self.modes, self.misfit_scale, strict=False):
            values = wide * values
            morphs.append(np.tensordot(values[: len(images)], images, 1))
            spectra.append(self._spectra(values[len(images) :]))
        return morphs, np.array(spectra)

    def _spectra(self, values):
        """Spectra (..., C) [counts] of values (..., B) of the bands."""
        return (values if self.ties is None else self.ties.spread(values)) * self.unit
