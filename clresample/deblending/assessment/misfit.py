"""Misfit of each source: in sigma, and as a fraction of its flux."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.noise import HALF_WIDTH
from ..posterior.residuals import MIN_PIXELS, MISFIT_SIGMAS, remainder
from .extended import extended_light

# Part of a source's flux in a channel from which on a significant residual is a misfit. Errors of
# bright galaxies are about 1 % (Settings.flux_error_floor, structure, their growth with the
# residual), so that three of them cover less; simulated galaxies that are fitted well have fluxes
# within 3 %.
MISFIT_FRACTION = 0.03
# Part of the flux of all sources of a blend that is left where its model does not describe the
# data. What a single one leaves is said by its flag.
WRONG_FRACTION = 0.1
# chi2 per pixel, over that of the noise, from which on it is not of noise: weights whose sigma is
# wrong by 15 % somewhere in an image have as much.
WRONG_CHI2 = 1.3
# chi2 per pixel of a channel, over that of the noise, that is not of noise whatever is left.
WRONG_ANYWAY = 2.0
# chi2 per pixel, over that of the noise, that is not counted as misfit: weights are as right as
# that from place to place.
TRUSTED_CHI2 = 1.1
# [sigma] Smoothed residuals over this count as light that is left, and the mean absolute value that
# noise has there, over its scatter: 2 phi(2).
LEFT_SIGMAS, LEFT_BY_NOISE = 2.0, 0.108
# [px] Lags (y, x) at which noise may be correlated unstated; the opposite ones are alike.
LAGS_PX = (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)
# [sigma] Residuals of the sky are cut here before they are correlated: stars nobody listed.
CUT = 3.0


@dataclass(frozen=True, eq=False)
class Misfit:
    """Residual light of a model of S sources in C channels, by source and channel.

    residuals (S, C) [sigma]: see `max_filtered_residuals`, NaN unseen
    excess (S, C) [sigma]: by how much chi2 of the source's pixels is over TRUSTED_CHI2
    chi2 (S, C) [1]: per pixel there, over that of the noise; NaN without pixels
    light (S, C) [counts]: sum of the absolute residual there, smoothed with the PSF, without what
        noise adds; where a residual is over 5 sigma, at least the flux of that point source
    flux (S, C) [counts]: of the model, and at least its error at fixed morphology
    whole_excess, whole_chi2, whole_light (2, C): the same of the pixels of all sources together,
        and of all pixels of the channel on the frame
    wide_sigma, wide_part (S,): of light around point sources, see `extended_light`
    """

    residuals: np.ndarray
    excess: np.ndarray
    chi2: np.ndarray
    light: np.ndarray
    flux: np.ndarray
    whole_excess: np.ndarray
    whole_chi2: np.ndarray
    whole_light: np.ndarray
    wide_sigma: np.ndarray
    wide_part: np.ndarray

    def sigma(self) -> np.ndarray:
        """The largest one of residuals, excess and wide_sigma (S, C) [sigma], 0 or more."""
        return np.maximum(self._own_sigma, self.wide_sigma[:, None])

    def fraction(self) -> np.ndarray:
        """Light that is left over flux (S,), of the channel where it is the largest.

        0 where no channel has over 5 sigma.
        """
        part = np.where(self._own_sigma > MISFIT_SIGMAS, self.light / self.flux, 0.0)
        wide = np.where(self.wide_sigma > MISFIT_SIGMAS, self.wide_part, 0.0)
        return np.maximum(part.max(axis=1, initial=0.0), wide)

    def sources(self) -> np.ndarray:
        """Selects misfitted sources (S,): over 5 sigma and over MISFIT_FRACTION of the flux."""
        return self.fraction() > MISFIT_FRACTION

    @property
    def is_wrong(self) -> bool:
        """True if the model as a whole does not describe the data.

        chi2 of a channel is not of noise, where the sources are or on the frame, and much of the
        light is left, or that of the frame is large.
        """
        beyond = self.whole_chi2[1] > WRONG_ANYWAY
        return bool((self._wrong | [np.zeros_like(beyond), beyond & self._significant[1]]).any())

    @property
    def is_wrong_on_sources(self) -> bool:
        """The same of the pixels of the sources alone, whatever there is beside them."""
        return bool(self._wrong[0].any())

    @property
    def _own_sigma(self):
        return np.maximum(np.nan_to_num(self.residuals), np.nan_to_num(self.excess))

    @property
    def _significant(self):
        return self.whole_excess > MISFIT_SIGMAS

    @property
    def _wrong(self):
        much = self.whole_light > WRONG_FRACTION * self.flux.sum(axis=0)
        return (self.whole_chi2 > WRONG_CHI2) & much & self._significant


def misfit_of(result) -> Misfit:
    """Compares a fitted blend with its data."""
    n_sources, worst, rest = len(result.sources), [], []
    remainders = [remainder(result, i) for i in range(len(result.observations))]
    for left in remainders:
        worst.append(left.worst(n_sources))
        rest += [_of_channel(left, c, n_sources) for c in range(len(left.filtered))]
    own = [np.stack(rows, axis=-1) for rows in zip(*rest, strict=True)]  # (S + 2, C)
    fields = [np.concatenate(worst, axis=1), *(rows[:-2] for rows in own), _model_flux(result)]
    fields += [*(rows[-2:] for rows in own), *extended_light(result, remainders)]
    return Misfit(*fields)


def _of_channel(rest, c, n_sources):
    """excess, chi2, light (S + 2,) of a channel of a Remainder, the last ones of the whole."""
    used, owner = rest.used[c], rest.owner[c]

    def sums(where, values):
        own = where & (owner >= 0)
        found = np.bincount(owner[own], values[own], n_sources)
        return np.concatenate([found, [found.sum(), values[where].sum()]])

    count = sums(used, np.ones(used.shape))
    with np.errstate(invalid="ignore"):
        chi2 = sums(used, rest.residual[c] ** 2 / rest.noise[c]) / count
    size = np.nan_to_num(np.abs(rest.filtered[c]))
    left = np.where(size > LEFT_SIGMAS, size, 0.0) - LEFT_BY_NOISE
    seen = used & np.isfinite(rest.filtered[c])
    light = sums(seen, rest.power[c] * np.nan_to_num(rest.point[c]) * left)
    points = np.where(size > MISFIT_SIGMAS, size * np.nan_to_num(rest.point[c]), 0.0)
    np.maximum.at(light, np.where(owner < 0, n_sources + 1, owner)[seen], points[seen])
    excess = chi2_excess(chi2, count)
    if (excess > MISFIT_SIGMAS).any():  # else it is no misfit, however few pixels are independent
        excess = chi2_excess(chi2, count / correlation_sum(rest.residual[c], rest.sky[c]))
    return excess, chi2, np.maximum(light, 0.0)


def chi2_excess(chi2, n):
    """Excess [sigma] of chi2 per pixel over TRUSTED_CHI2, of n pixels of independent noise.

    The cube root of chi2 / n is all but normal, with mean 1 - 2 / 9n and variance 2 / 9n (Wilson &
    Hilferty 1931, PNAS 17, 684): noise is over 5 sigma once in 3e6, from 10 pixels on.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = 2 / (9 * np.asarray(n, float))
        return (np.cbrt(chi2 / TRUSTED_CHI2) - 1 + variance) / np.sqrt(variance)


def correlation_sum(residual, sky):
    """Sum of the squared correlations of the noise at all lags, 1 where it is white.

    The variance of chi2 is larger by this factor. residual (Ny, Nx); sky (Ny, Nx) bool: where it is
    noise alone.
    """
    if sky.sum() < MIN_PIXELS:
        return 1.0
    noise = np.where(sky, residual, 0.0)
    scale = np.median(np.abs(noise[sky])) / HALF_WIDTH
    if not scale > 0:
        return 1.0
    noise, total = np.clip(noise, -CUT * scale, CUT * scale), 1.0
    power = (noise**2).sum() / sky.sum()
    for lag in LAGS_PX:
        here, there = _apart(lag)
        n = (sky[here] & sky[there]).sum()
        rho = (noise[here] * noise[there]).sum() / max(n, 1) / power
        total += 2 * max(rho**2 - 1 / max(n, 1), 0.0)  # without what noise adds
    return float(total)


def _apart(lag):
    """Index of all pixels that have a neighbour at a lag (y, x), y >= 0, and that of these."""
    dy, dx = lag
    rows = slice(None, -dy or None), slice(dy, None)
    columns = slice(max(-dx, 0), -dx if dx > 0 else None), slice(max(dx, 0), dx if dx < 0 else None)
    return (rows[0], columns[0]), (rows[1], columns[1])


def _model_flux(result):
    """The `flux` of Misfit."""
    found, error = np.zeros((2, len(result.sources), len(result.channels)))
    for i, c in enumerate(result.components):
        total = c.morphology.sum()
        found[c.source] += c.spectrum * total
        error[c.source] += np.sqrt(np.maximum(result.covariance[:, i, i], 0)) * total
    return np.maximum(np.maximum(found, error), 1e-300)
