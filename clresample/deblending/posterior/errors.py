"""The covariances, error maps and posterior sampler that a Result stores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import strmm
from scipy.sparse import csr_array

from ..linear.block_matrix import RIDGE, BlockCholesky
from ..linear.mode_images import ModeImages, combined
from ..linear.ties import Ties

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
        fixed projection onto its smooth profile; MorphologyErrors, computed when first read
    outside_box_moments (n, 6) [1, px, px^2]: a contribution to fluxes and moments, not an error:
        the sums of each component's smooth profile beyond its box, times 1, y, x, y y, y x, x x of
        the frame, if the morphology has its maximum 1
    flux_correction (S, C) [counts], moment_bound_bias (S, 5) [px, px^2]: corrections, not errors:
        the changes of fluxes, and of centroids and second moments, without the bounds of
        morphologies and spectra at 0, see bound_bias.py; 0 for second moments of stars. Fluxes of
        faint galaxies also have the change to their mean over sizes and wings, see
        start/shape_grid.py
    residuals (S, C) [sigma]: the largest on each source, see `channel_residuals`
    outside (S, C) [counts]: flux of the models outside the observed area, see `light_outside`; its
        square is included in `flux` and `colour`. 0 by default
    unsettled (S, C) [counts]: largest change of the fluxes in the last iterations, an estimate of
        that in further ones, from `unsettled_fluxes`; `flux` and `colour` include the products of
        signed changes (`largest_changes`). 0 if the fit converged, infinite where unknown
    """

    flux: np.ndarray
    colour: np.ndarray
    moments: np.ndarray
    morphology: Sequence[np.ndarray]
    outside_box_moments: np.ndarray
    flux_correction: np.ndarray
    moment_bound_bias: np.ndarray
    residuals: np.ndarray
    outside: np.ndarray | None = None
    unsettled: np.ndarray | None = None

    def __post_init__(self):
        for name, value in (("outside", 0.0), ("unsettled", np.inf)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(np.shape(self.flux_correction), value))


@dataclass(frozen=True, eq=False)
class FluxChanges:
    """Independent changes of fluxes, of scatter 1, beside those of components; see shared_light.py.

    source, change (m,): whose flux changes by which of them; by (m, C) [counts]: how much
    """

    source: np.ndarray
    change: np.ndarray
    by: np.ndarray

    def draw(self, n_sources, rng):
        """Changes (S, C) [counts] of all fluxes."""
        values = rng.standard_normal(self.change.max(initial=-1) + 1)
        out = np.zeros((n_sources, self.by.shape[1]))
        np.add.at(out, self.source, values[self.change, None] * self.by)
        return out

    def added_to(self, errors) -> Errors:
        """Errors with the covariance of these changes too, of which each is once in a source."""
        flux, colour = errors.flux.copy(), errors.colour.copy()
        shape = len(colour), self.change.max(initial=-1) + 1
        for c, by in enumerate(self.by.T):
            np.add.at(colour[:, c], self.source, by[:, None] * self.by)
            changes = csr_array((by, (self.source, self.change)), shape)
            flux[c] += (changes @ changes.T).toarray()
        return replace(errors, flux=flux, colour=colour)


@dataclass(frozen=True, eq=False)
class PosteriorSampler:
    """Means and factors from which samples of the posterior are drawn.

    modes (n): (k_i, ny, nx), images of each component's modes, arrays or ModeImages
    sums (n): (1 + k_i,), sums of its morphology and of its modes, light beyond its box included
    factor: of the normal matrix, whose node i is component i, its modes and then its spectrum (B,)
    unit (C,) [counts]: unit of the spectra there
    misfit_scale (n,): factor of the scatter of misfitted sources' components, as for their Errors
    ties: Ties of the channels, of B bands; None: B = C
    flux_changes: of fluxes, beside those of components; None without any
    """

    modes: Sequence[np.ndarray | ModeImages]
    sums: Sequence[np.ndarray]
    factor: BlockCholesky
    unit: np.ndarray
    misfit_scale: np.ndarray
    ties: Ties | None = None
    flux_changes: FluxChanges | None = None

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
        morphs = combined(images, values[:, : len(images)])
        return morphs, self._spectra(values[:, len(images) :])

    def draw(self, rng):
        """Changes of the morphologies (n arrays) and of the spectra (n, C) [counts]."""
        pairs = list(zip(self._drawn(rng), self.modes, strict=False))
        morphs = [combined(images, values[: len(images)]) for values, images in pairs]
        spectra = [self._spectra(values[len(images) :]) for values, images in pairs]
        return morphs, np.array(spectra)

    def draw_fluxes(self, spectra, rng):
        """Changes (n, C) [counts] of the fluxes of components of these spectra, to first order."""
        return np.array(
            [
                spectrum * (values[: len(sums) - 1] @ sums[1:])
                + sums[0] * self._spectra(values[len(sums) - 1 :])
                for values, sums, spectrum in zip(
                    self._drawn(rng), self.sums, spectra, strict=False
                )
            ]
        )

    def _drawn(self, rng):
        """Values of each component's unknowns (n), then of those of all together."""
        found = self.factor.draw(rng.standard_normal(sum(self.factor.sizes)))
        return [wide * values for wide, values in zip(self.misfit_scale, found, strict=False)]

    def _spectra(self, values):
        """Spectra (..., C) [counts] of values (..., B) of the bands."""
        return (values if self.ties is None else self.ties.spread(values)) * self.unit


class MorphologyErrors(Sequence):
    """Standard deviations of morphologies, n arrays (ny, nx), computed when one is first read.

    A catalogue reads none, and they take a tenth of the time of all errors.

    draws: PosteriorSampler
    """

    def __init__(self, draws: PosteriorSampler):
        self._draws = draws

    def __len__(self):
        return len(self._draws.modes)

    def __getitem__(self, i):
        return self._maps[i]

    @cached_property
    def _maps(self):
        draws, covariance = self._draws, self._draws.factor.inverse()
        return tuple(
            wide * _standard_deviation(images, covariance.block(i, i)[: len(images), : len(images)])
            for i, (images, wide) in enumerate(zip(draws.modes, draws.misfit_scale, strict=True))
        )


def _standard_deviation(images, covariance):
    """Standard deviation (ny, nx) of a sum of images (k, ny, nx); covariance (k, k) of factors."""
    images = np.asarray(images)
    k, shape = len(images), images.shape[1:]
    if not k:
        return np.zeros(shape)
    ridge = np.diag(RIDGE * np.diag(covariance))  # more than its rounding
    root = np.linalg.cholesky(covariance + ridge).astype(np.float32)
    # the transpose, since BLAS counts rows first
    turned = strmm(1.0, root, images.reshape(k, -1).T, side=1, lower=1)
    return np.sqrt(np.square(turned, out=turned).sum(1)).astype(float).reshape(shape)
