"""Factorises the normal matrix of all unknowns of a scene and derives its errors from it."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cached_property

import numpy as np

from ..assessment.cores import core_errors
from ..assessment.edge import light_outside
from ..assessment.extended import missed_light
from ..assessment.psf_width import width_errors
from ..assessment.status import with_misfit_status
from ..assessment.unsettled import largest_changes, unsettled_fluxes
from ..component_images import local_chi2
from ..linear.aligned_observation import align_observations
from ..linear.block_matrix import BlockCholesky
from ..linear.mode_images import ModeImages
from ..linear.normal import UnknownLayout, normal_matrix
from ..result import noted
from .bound_bias import negative_chi2_gradient, release_factor, within_errors
from .errors import Errors, MorphologyErrors, PosteriorSampler
from .modes import FLOOR_EXPONENT, Solution, clipped_power
from .moments import light_sums, moment_derivatives
from .residuals import channel_residuals, misfit_error_scale
from .shared_light import (
    doubted_shapes,
    exchanged_light,
    flux_changes,
    flux_doubts,
)

# Smallest relative error of a spectrum at fixed morphology: smaller ones are rounding errors.
MIN_ERROR = 1e-9
# Relative error of the light of a profile beyond its box, where it is below the noise. Fluxes of
# galaxies of r_e over 30 px and signal to noise 30 to 60 are 15 % too faint: two of their errors,
# and three without this contribution (bench.ladder).
FAR_ERROR = 0.3


class Posterior:
    """The linear posterior about a solution.

    solution: Solution; exposures: an AlignedObservation of each observation
    fit_sky, fit_shifts: True if sky levels, and shifts of all observations but the first, are
        unknowns

    modes (n): (k, ny, nx), beyond (n): see Solution.modes; layout: UnknownLayout; matrix:
        BlockMatrix; factor: its BlockCholesky; covariance: a BlockMatrix of the inverse, for the
        same nodes
    released: arrays, for each node the changes of its unknowns without the bounds at 0, see
        bound_bias.py

    Raises LinAlgError where the matrix is not positive definite.
    """

    def __init__(self, solution, exposures, *, fit_sky=False, fit_shifts=False):
        n, n_channels = solution.spectra.shape
        self.solution = solution
        found = zip(*(solution.modes(i) for i in range(n)), strict=True)
        images, self.modes, self.beyond, held = found
        smooth = [m.smooth if isinstance(m, ModeImages) else () for m in self.modes]
        self.layout = UnknownLayout(
            np.array([len(m) for m in self.modes]),
            n_channels,
            n_channels if fit_sky else 0,
            2 * (len(exposures) - 1) if fit_shifts else 0,
            solution.scene.ties,
        )
        self.matrix = normal_matrix(
            solution.scene, exposures, images, solution.spectra, self.layout, smooth
        )
        self.factor = BlockCholesky(self.matrix)
        self.covariance = self.factor.inverse()
        self.released = self._released(held)

    def _released(self, held):
        """See the class; held (n): arrays (k,), gradients by each component's modes there."""
        right = [np.zeros(size) for size in self.layout.sizes]
        for i, pull in enumerate(held):
            k, own = len(pull), self.covariance.block(i, i)
            right[i][:k] = pull * release_factor(pull @ own[:k, :k] @ pull, k)
            pull = self.layout.by_band(self.solution.held[i])
            right[i][k:] = pull * release_factor(pull**2 * np.diag(own)[k:])
        return self.factor.solve(right)

    def errors(self, owner, residuals, unit, own) -> Errors:
        """The Errors of sources, component i belonging to source owner[i] (n,).

        residuals (S, C) [sigma]: that widen them; unit (C,) [counts]: of the spectra
        own (m, S, C) [counts]: further changes of each source's fluxes alone, see `floors`, with
            which channels are weighted for moments
        """
        n_sources, wide = len(residuals), misfit_error_scale(residuals)
        slopes, n_channels = self.flux_slopes, len(unit)
        between = np.zeros((n_channels, n_sources, n_sources))
        colour = np.zeros((n_sources, n_channels, n_channels))
        for (i, j), block in self.covariance.items():
            if j == self.layout.common:
                continue
            part, s, t = slopes[i] @ block, owner[i], owner[j]
            by_channel = np.einsum("cu,cu->c", part, slopes[j])
            between[:, s, t] += by_channel
            if i != j:
                between[:, t, s] += by_channel
            if s == t:
                found = part @ slopes[j].T
                colour[s] += found if i == j else found + found.T
        released = np.zeros((n_sources, n_channels))
        for s, slope, change in zip(owner, slopes, self.released, strict=False):
            released[s] += slope @ change
        released = within_errors(released.T, between).T
        scale = wide[:, None] * unit
        variance = np.diagonal(colour, axis1=1, axis2=2) + np.square(own / scale).sum(axis=0)
        moments, moved = self._moments(owner, n_sources, np.sqrt(variance))
        return Errors(
            between * scale.T[:, :, None] * scale.T[:, None],
            colour * scale[:, :, None] * scale[:, None],
            moments * wide[:, None, None] ** 2,
            MorphologyErrors(self.draws(owner, residuals, unit)),
            np.array([far[:, 0] for far in self.beyond]),
            released * unit,
            moved,
            residuals,
        )

    def floors(self, owner, residuals, unit, flux_error_floor):
        """Changes (2, S, C) [counts] of scatter 1 of fluxes, common to all channels of a source.

        They are Settings.flux_error_floor, and FAR_ERROR of the light beyond the boxes; for the
        other arguments see `errors`.
        """
        floor, far = np.zeros((2, len(residuals), self.layout.n_channels))
        for i, (slope, beyond) in enumerate(zip(self.flux_slopes, self.beyond, strict=True)):
            spectrum, unlike = self.solution.spectra[i], self.solution.structure_excess(i)
            own = spectrum * slope[0, -self.layout.n_spectra]  # its flux
            floor[owner[i]] += flux_error_floor * clipped_power(unlike, FLOOR_EXPONENT) * own
            far[owner[i]] += FAR_ERROR * spectrum * beyond[0, 0]
        return np.stack([floor, far]) * misfit_error_scale(residuals)[:, None] * unit

    def draws(self, owner, residuals, unit) -> PosteriorSampler:
        """Sampler of the posterior for `Result.sample`; for its arguments see `errors`."""
        wide, sums = misfit_error_scale(residuals)[owner], [one[0] for one in self._sums]
        return PosteriorSampler(self.modes, sums, self.factor, unit, wide, self.layout.ties)

    @cached_property
    def _sums(self):
        """`light_sums` (6, 1 + k) of each component's morphology and modes, beyond its box too."""
        pairs = zip(self.solution.scene.origin, self.solution.morphs, self.modes, self.beyond)
        return [
            far + np.concatenate([light_sums(morph[None], at), light_sums(modes, at)], axis=1)
            for at, morph, modes, far in pairs
        ]

    @cached_property
    def flux_slopes(self):
        """Slopes (C, k + B) of each component's flux by its unknowns."""
        ties = self.layout.ties
        of_channels = np.eye(self.layout.n_channels) if ties is None else ties.matrix
        return [
            np.concatenate([np.outer(spectrum, sums[0, 1:]), sums[0, 0] * of_channels], axis=1)
            for spectrum, sums in zip(self.solution.spectra, self._sums, strict=True)
        ]

    def _moments(self, owner, n_sources, error):
        """Covariances (S, 5, 5) of centroids and second moments, and their bound bias (S, 5).

        error (S, C): of the fluxes.
        """
        s, out, moved = self.solution, np.full((n_sources, 5, 5), np.nan), np.zeros((n_sources, 5))
        for source in np.unique(owner):
            own = np.flatnonzero(owner == source)
            weight = np.where(error[source] > 0, 1 / np.maximum(error[source], 1e-30), 0)
            weight, by_band = self.layout.band_weights(weight)
            light = s.spectra[own] @ weight
            n_modes = sum(len(self.modes[i]) for i in own)
            if not n_modes or not light.any():
                continue
            sums = [self._sums[i] for i in own]
            by_sums = moment_derivatives(sum(a * one[:, 0] for a, one in zip(light, sums)))
            rows = []
            for one, part in zip(sums, light, strict=True):
                slopes = by_sums @ one
                rows.append(np.concatenate([part * slopes[:, 1:], slopes[:, :1] * by_band], axis=1))
            covariance = np.zeros((5, 5))
            for a, i in enumerate(own):
                for b, j in enumerate(own):
                    block = self.covariance.block(min(i, j), max(i, j))
                    covariance += rows[a] @ (block if i <= j else block.T) @ rows[b].T
            moved[source] = sum(row @ self.released[i] for i, row in zip(own, rows, strict=True))
            if s.scene.fixed[own].all():  # a star's position was fitted, but no shape
                covariance[2:] = covariance[:, 2:] = np.nan
                moved[source, 2:] = 0
            out[source] = covariance
        return out, moved


def with_errors(fit, result, peaks, seen):
    """The Result of a finished Fit with Errors and PosteriorSampler, or messages instead.

    peaks, seen: see `posterior_of`

    The time is recorded in the fit.
    """
    began, result = time.perf_counter(), with_misfit_status(result)
    morphs = [c.morphology for c in result.components]
    posterior, messages = posterior_of(fit, morphs, peaks, seen)
    if posterior is None:
        return noted(result, messages=(*result.messages, *messages))
    owner, residuals = fit.fitted[fit.start.source], channel_residuals(result)
    floors = posterior.floors(owner, residuals, fit.unit, fit.settings.flux_error_floor)
    errors = posterior.errors(owner, residuals, fit.unit, floors)
    draws = posterior.draws(owner, residuals, fit.unit)
    start = fit.start
    outside = light_outside(
        result, start.shapes, start.thetas, start.positions[start.source], peaks
    )
    fit.note_seconds("errors", time.perf_counter() - began)
    change, scatter, noise = np.zeros((3, len(result.sources), len(fit.unit)))
    estimate = np.moveaxis(start.flux_estimate * fit.unit, 1, 0)
    change[fit.fitted], scatter[fit.fitted], noise[fit.fitted] = estimate
    errors = replace(errors, flux_correction=errors.flux_correction + change)
    unsettled = unsettled_fluxes(fit)
    doubted = doubted_shapes(posterior)
    doubts = flux_doubts(posterior, doubted, owner, len(result.sources)) * fit.unit[:, None]
    division = np.zeros((*noise.shape, start.flux_doubt.shape[2]))
    division[fit.fitted] = start.flux_doubt * fit.unit[:, None]
    # Each of these changes one source's fluxes alone. By the larger of curvature and scatter 64 %
    # of fluxes at signal to noise 10 to 20 would be within their errors, by both together 70 %
    # (bench.ladder, single).
    bands = np.eye(len(fit.unit)) if fit.ties is None else fit.ties.matrix
    by_band = np.where(bands.T[:, None], np.hypot(width_errors(result), noise), 0)
    own = np.stack([*floors, missed_light(result), scatter, *by_band])
    doubts = np.concatenate([doubts, division, largest_changes(unsettled, fit.unit)], axis=2)
    shared = doubts, exchanged_light(result, posterior.solution, doubted)
    # Not drawn is the light outside, common to a source's channels, and that of cores, of each.
    cores = np.eye(len(fit.unit))[:, None] * core_errors(result)
    changes = flux_changes(*shared, np.concatenate([own, outside[None], cores]))
    errors = errors if changes is None else changes.added_to(errors)
    largest = np.abs(unsettled).max(axis=2, initial=0)
    errors = replace(errors, outside=outside, unsettled=largest)
    draws = replace(draws, flux_changes=flux_changes(*shared, own))
    return noted(result, errors=errors, draws=draws)


def posterior_of(fit, morphs, peaks, seen):
    """The Posterior of a finished Fit, or None, and messages with the reason.

    morphs (n): its components' morphologies with max = 1; peaks (n,): their maxima before that;
    seen: RenderedModel, of these
    """
    settings, scene = fit.settings, fit.scene
    if fit.strength_estimates is None or not settings.errors:
        return None, []
    spectra, covariance = seen.spectra, seen.covariance
    variance = np.diagonal(covariance, axis1=1, axis2=2).T
    if (
        scene.ties is not None
    ):  # those of one exposure, since each exposure of a band has its own weight
        variance = variance * scene.ties.count
    channels = scene.channels()
    residuals = seen.residuals(channels, fit.views)
    solution = Solution(
        scene,
        morphs,
        peaks,
        spectra,
        np.sqrt(np.maximum(variance, (MIN_ERROR * spectra) ** 2 + 1e-300)),
        fit.start.shapes,
        fit.start.thetas,
        fit.start.positions[fit.start.source],
        fit.start.source,
        fit.strength_estimates,
        local_chi2(seen.observed, fit.views, channels, spectra, residuals),
        settings.prior,
        negative_chi2_gradient(scene, fit.views, fit.start.source, seen.spectra, residuals),
        seen.held,
    )
    try:
        sky, shifts = settings.fit_sky, settings.fit_shifts
        return Posterior(solution, align_observations(fit), fit_sky=sky, fit_shifts=shifts), []
    except np.linalg.LinAlgError:
        why = "their normal matrix is not positive definite"
    return None, [f"errors are those of fixed morphologies: {why}"]
