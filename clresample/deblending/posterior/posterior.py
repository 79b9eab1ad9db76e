"""A scene's errors: unknowns laid out, one factored normal matrix, and what is asked of it."""

from __future__ import annotations

import time

import numpy as np
from scipy.linalg import solve_triangular

from .errors import Draws, Errors
from .modes import Solution
from .moments import moments_of
from .normal import Exposure, Layout, factor, normal_matrix

# Unknowns of a scene from which on its errors are those of fixed morphologies: 2000, of 30 to
# 40 sources, make a matrix of 32 MB and a second of work, which grows with their third power.
MOST_UNKNOWNS = 2000
# Least error of a spectrum at fixed morphology, relative to it: smaller ones are rounding.
LEAST_ERROR = 1e-9


class TooLargeError(ValueError):
    """A scene has more unknowns than MOST_UNKNOWNS."""


class Posterior:
    """The linear posterior about a solution.

    solution: Solution; exposures: an Exposure of each observation
    fit_sky: whether sky levels are unknowns too

    modes (n): Modes; layout: Layout; lower, scale: see `factor`

    Raises TooLargeError, and LinAlgError where the matrix is not positive definite.
    """

    def __init__(self, solution, exposures, *, fit_sky=False):
        n, n_channels = solution.spectra.shape
        most = MOST_UNKNOWNS - (n + bool(fit_sky)) * n_channels
        self.solution, self.modes, count = solution, [], 0
        for i in range(n):
            self.modes.append(solution.modes(i))
            count += len(self.modes[-1])
            if count > most:
                raise TooLargeError(f"more than {MOST_UNKNOWNS} unknowns")
        ends = np.cumsum([0, *map(len, self.modes)])
        self.layout = Layout(ends, n_channels, n_channels if fit_sky else 0)
        matrix = normal_matrix(
            solution.scene,
            exposures,
            solution.morphs,
            self.modes,
            solution.spectra,
            self.layout,
        )
        self.lower, self.scale = factor(matrix)

    def errors(self, owner, n_sources, unit, flux_floor) -> Errors:
        """The Errors of sources, component i belonging to source owner[i] (n,).

        unit (C,) [counts]: of the spectra; flux_floor: see Settings
        """
        flux, flux_rows = self._fluxes(owner, n_sources)
        spread = self._half(flux_rows.reshape(-1, self.layout.size))
        full = (spread.T @ spread).reshape(*flux.shape, *flux.shape)  # (S, C, S, C)
        between = np.einsum("sctc->cst", full).copy()
        colour = np.einsum("scsd->scd", full).copy()
        floor = flux_floor * flux
        between[:, np.arange(n_sources), np.arange(n_sources)] += floor.T**2
        colour += floor[:, :, None] * floor[:, None, :]
        error = np.sqrt(np.diagonal(colour, axis1=1, axis2=2))
        return Errors(
            between * unit[:, None, None] ** 2,
            colour * unit[:, None] * unit,
            self._moments(owner, n_sources, error),
            tuple(self._map(i) for i in range(len(self.modes))),
        )

    def draws(self, unit) -> Draws:
        """What `Result.sample` draws from."""
        modes = [m.images.astype(np.float32) for m in self.modes]
        return Draws(modes, self.lower, self.scale, unit)

    def _half(self, rows):
        """(N, r) whose columns' inner products are the covariance of rows (r, N) of slopes."""
        return solve_triangular(self.lower, (rows / self.scale).T, lower=True)

    def _fluxes(self, owner, n_sources):
        """Fluxes (S, C) and their slopes (S, C, N)."""
        s, layout = self.solution, self.layout
        flux = np.zeros((n_sources, layout.n_channels))
        rows = np.zeros((*flux.shape, layout.size))
        for i, (modes, morph) in enumerate(zip(self.modes, s.morphs, strict=True)):
            total, channels = morph.sum(), np.arange(layout.n_channels)
            flux[owner[i]] += s.spectra[i] * total
            rows[owner[i]][:, layout.modes(i)] += np.outer(s.spectra[i], modes.images.sum((1, 2)))
            rows[owner[i], channels, layout.spectrum(i)] += total
        return flux, rows

    def _moments(self, owner, n_sources, error):
        """Covariances (S, 5, 5) of centroids and second moments; error (S, C): of the fluxes."""
        s, layout, out = self.solution, self.layout, np.full((n_sources, 5, 5), np.nan)
        for source in np.unique(owner):
            own = np.flatnonzero(owner == source)
            weight = np.where(error[source] > 0, 1 / np.maximum(error[source], 1e-30), 0)
            light = s.spectra[own] @ weight
            n_modes = sum(len(self.modes[i]) for i in own)
            if not n_modes or not light.any():
                continue
            slopes = moments_of(s.scene.origin[own], [s.morphs[i] for i in own], light)
            rows = np.zeros((5, layout.size))
            for i, slope, part in zip(own, slopes, light, strict=True):
                modes = self.modes[i].images
                rows[:, layout.modes(i)] = part * np.tensordot(slope, modes, ((1, 2), (1, 2)))
                by_light = np.tensordot(slope, s.morphs[i], 2)
                rows[:, layout.spectrum(i)] = by_light[:, None] * weight
            half = self._half(rows)
            covariance = half.T @ half
            if s.scene.fixed[own].all():
                covariance[2:] = covariance[:, 2:] = np.nan
            out[source] = covariance
        return out

    def _map(self, i):
        """Standard deviation (ny, nx) of component i's morphology."""
        images, own = self.modes[i].images, self.layout.modes(i)
        if not len(images):
            return np.zeros(self.solution.morphs[i].shape)
        rows = np.zeros((len(own), self.layout.size))
        rows[np.arange(len(own)), own] = 1
        half = self._half(rows)
        flat = images.reshape(len(own), -1)
        variance = ((half.T @ half @ flat) * flat).sum(0)
        return np.sqrt(np.maximum(variance, 0)).reshape(images.shape[1:])


def errors_of(fit, components, peaks, units, solved):
    """The Errors and Draws of a Fit that has ended with these Components, or None and None.

    peaks, units, solved: see `posterior_of`

    Messages and seconds of it are taken down in the fit.
    """
    began = time.perf_counter()
    morphs = [c.morphology for c in components]
    posterior, messages = posterior_of(fit, morphs, peaks, units, solved)
    fit.messages += messages
    if posterior is None:
        return None, None
    owner, floor = fit.fitted[fit.start.source], fit.settings.flux_floor
    errors = posterior.errors(owner, len(fit.sources), fit.unit, floor)
    fit.note_seconds("errors", time.perf_counter() - began)
    return errors, posterior.draws(fit.unit)


def posterior_of(fit, morphs, peaks, units, solved):
    """The Posterior of a Fit that has ended, or None, and messages of why there is none.

    morphs (n): its components' morphologies with max = 1, peaks (n,): what they were divided by;
    units, solved: see `solve_spectra`: what it took and returned
    """
    settings, scene = fit.settings, fit.scene
    if not settings.learns or fit.findings is None:
        return None, []
    spectra, sky, covariance = solved
    variance = np.diagonal(covariance, axis1=1, axis2=2).T
    solution = Solution(
        scene,
        morphs,
        peaks,
        spectra,
        np.sqrt(np.maximum(variance, (LEAST_ERROR * spectra) ** 2 + 1e-300)),
        fit.start.shapes,
        fit.start.thetas,
        fit.start.positions[fit.start.source],
        fit.findings,
        _local_chi2(units, fit.views, spectra, sky),
        settings.prior,
    )
    pairs = zip(fit.views, fit.blend.observations, strict=True)
    exposures = [Exposure.of(view, fit.frame, o) for view, o in pairs]
    try:
        return Posterior(solution, exposures, fit_sky=settings.fit_sky), []
    except TooLargeError as error:
        why = str(error)
    except np.linalg.LinAlgError:
        why = "their normal matrix is not positive definite"
    return None, [f"errors are those of fixed morphologies: {why}"]


def _local_chi2(units, views, spectra, sky):
    """chi2 per pixel (n,) where each component's light is, by A^2 times its image."""
    found, seen, channel = 0.0, 0.0, 0
    for unit, view in zip(units, views, strict=True):
        for c in range(unit.shape[1]):
            root, a = view.root[c].ravel(), spectra[:, channel]
            model = a @ unit[:, c] + sky[channel] * root
            residual = view.data[c].ravel() * root - model
            found = found + a**2 * (unit[:, c] @ (root * residual**2))
            seen = seen + a**2 * (unit[:, c] @ root)
            channel += 1
    return found / np.maximum(seen, 1e-30)
