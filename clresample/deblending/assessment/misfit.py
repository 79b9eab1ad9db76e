"""Misfit of each source: in sigma, and as a fraction of its flux."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...sky.noise import HALF_WIDTH
from ..posterior.residuals import MIN_PIXELS, MISFIT_SIGMAS, remainder
from .cores import star_variance
from .extended import WIDE_SIGMAS, extended_light
from .photon_noise import photon_gains

# Fraction of a source's flux in a channel from which a significant residual is a misfit. Smaller
# residuals are within three errors of bright galaxies, which are about 1 %
# (Settings.flux_error_floor, structure, and their growth with the residual). Simulated galaxies
# with good fits have fluxes within 3 %.
MISFIT_FRACTION = 0.03
# chi2 per pixel, relative to that of the noise, up to which it does not count as misfit: the local
# accuracy of weights.
TRUSTED_CHI2 = 1.1
# [sigma] Smoothed residuals above this count as residual light. Then the mean absolute value of
# noise above it, in units of the scatter: 2 phi(2).
LEFT_SIGMAS, LEFT_BY_NOISE = 2.0, 0.108
# [1] Scatter of the sky's residuals, in units of the weights' noise, above which errors are wrong:
# they are too small by as much. Of less the inspection warns, and fits are no worse than others.
MAX_SCATTER = 4.0
# [px] Lags (y, x) at which noise may be correlated although not declared; opposite lags are equal.
LAGS_PX = (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)
# [sigma] Residuals of the sky are clipped here before correlation, because of unlisted stars.
CUT = 3.0


@dataclass(frozen=True, eq=False)
class Misfit:
    """Residual light of a model of S sources in C channels, by source and channel.

    residuals (S, C) [sigma]: see `max_filtered_residuals`, NaN unseen
    excess (S, C) [sigma]: by how much chi2 of the source's pixels is over TRUSTED_CHI2
    chi2 (S, C) [1]: per pixel there, over that of the noise and of the error of stars' PSFs; NaN
        without pixels
    light (S, C) [counts]: sum of the absolute residual there, smoothed with the PSF, minus the
        contribution of noise; if a residual is over 5 sigma, at least the flux of that point source
    flux (S, C) [counts]: of the model on pixels with a weight, since that of a saturated star's
        core says nothing of its fit; at least the flux error at fixed morphology
    whole_excess, whole_chi2 (2, C): the same for the pixels of all sources together, and of all
        pixels of the channel on the frame
    scatter (C,) [1]: of the sky's residuals, in units of the weights' noise, 1 or more; 1 of fewer
        than MIN_PIXELS of them
    gains (C,) [1]: see `photon_gains`; NaN where chi2 is that of noise in all channels
    wide_sigma, wide_part (S,): of light around point sources, see `extended_light`
    """

    residuals: np.ndarray
    excess: np.ndarray
    chi2: np.ndarray
    light: np.ndarray
    flux: np.ndarray
    whole_excess: np.ndarray
    whole_chi2: np.ndarray
    scatter: np.ndarray
    gains: np.ndarray
    wide_sigma: np.ndarray
    wide_part: np.ndarray

    def own_sigma(self) -> np.ndarray:
        """The larger one of residuals and excess (S, C) [sigma], 0 or more."""
        return np.maximum(np.nan_to_num(self.residuals), np.nan_to_num(self.excess)).clip(0)

    def sigma(self) -> np.ndarray:
        """The largest one of `own_sigma` and wide_sigma (S, C) [sigma]."""
        return np.maximum(self.own_sigma(), self.wide_sigma[:, None])

    def fraction(self) -> np.ndarray:
        """Residual light over flux (S,), in the channel where it is largest.

        0 where no channel has over 5 sigma, and no light around a point has over WIDE_SIGMAS.
        """
        part = np.where(self.own_sigma() > MISFIT_SIGMAS, self.light / self.flux, 0.0)
        wide = np.where(self.wide_sigma > WIDE_SIGMAS, self.wide_part, 0.0)
        return np.maximum(part.max(axis=1, initial=0.0), wide)

    def sources(self) -> np.ndarray:
        """Selects misfitted sources (S,): those with a `fraction` over MISFIT_FRACTION."""
        return self.fraction() > MISFIT_FRACTION

    def significant(self) -> np.ndarray:
        """Selects sources (S,) with a `sigma` over MISFIT_SIGMAS, however small its `fraction`."""
        return self.sigma().max(axis=1, initial=0.0) > MISFIT_SIGMAS

    @property
    def is_wrong(self) -> bool:
        """True if chi2 of a channel is not that of noise, or its noise not that of the weights."""
        return self.is_unlike_noise or self.is_noisier

    @property
    def is_noisier(self) -> bool:
        """True if the noise of a channel is many times that of the weights."""
        return bool((self.scatter > MAX_SCATTER).any())

    @property
    def is_unlike_noise(self) -> bool:
        """True if chi2 of a channel is not that of noise, at the sources or on the frame."""
        return self.is_wrong_on_sources or bool((self.whole_excess[1] > MISFIT_SIGMAS).any())

    @property
    def is_wrong_on_sources(self) -> bool:
        """`is_unlike_noise` for the pixels of the sources alone."""
        return bool((self.whole_excess[0] > MISFIT_SIGMAS).any())


def misfit_of(result) -> Misfit:
    """Compares a fitted blend with its data."""
    n_sources, worst, rest = len(result.sources), [], []
    remainders = [remainder(result, i) for i in range(len(result.observations))]
    for i, left in enumerate(remainders):
        worst.append(left.worst(n_sources))
        noise, by_stars = left.noise[:, None, None], star_variance(result, i)
        if by_stars is not None:
            noise = noise + result.observations[i].whitened.weights * by_stars
        rest += [_of_channel(left, c, n_sources, noise[c]) for c in range(len(left.filtered))]
    own = [np.stack(rows, axis=-1) for rows in zip(*rest, strict=True)]  # (S + 2, C)
    fields = [np.concatenate(worst, axis=1), *(rows[:-2] for rows in own)]
    fields += [_observed_flux(result, remainders)]
    fields += [*(rows[-2:] for rows in own[:2])]
    fields += [np.sqrt(np.concatenate([left.noise for left in remainders]))]
    fields += [np.full(len(result.channels), np.nan), *extended_light(result, remainders)]
    misfit = Misfit(*fields)
    if not misfit.is_unlike_noise:
        return misfit
    return replace(misfit, gains=photon_gains(result, remainders))


def _of_channel(rest, c, n_sources, noise):
    """excess, chi2, light (S + 2,) of a channel of a Remainder, the last two for the whole.

    noise (My, Mx) or (1, 1) [sigma^2]: variance of its residual. Pixels where that is mostly the
        error of stars' PSFs would hide others' chi2: the larger excess with and without them counts
    """
    used, owner = rest.used[c], rest.owner[c]

    def sums(where, values=None):
        labels = np.where(where, owner + 2, 0).ravel()  # 1: of no source
        found = np.bincount(labels, values if values is None else values.ravel(), n_sources + 2)
        return np.concatenate([found[2:], [found[2:].sum(), found[1:].sum()]])

    def of_pixels(where):
        count = sums(where)
        with np.errstate(invalid="ignore"):
            chi2 = sums(where, rest.residual[c] ** 2 / noise) / count
        excess = chi2_excess(chi2, count)
        if (excess > MISFIT_SIGMAS).any():  # if not, nor with fewer independent pixels
            excess = chi2_excess(chi2, count / correlation_sum(rest.residual[c], rest.sky[c]))
        return excess, chi2

    excess, chi2 = of_pixels(used)
    by_noise = used & (noise < 2 * rest.noise[c])
    if by_noise.sum() < used.sum():
        found, chi2_by_noise = of_pixels(by_noise)
        chi2 = np.where(found > excess, chi2_by_noise, chi2)
        excess = np.fmax(excess, found)
    size = np.abs(rest.filtered[c])  # NaN unseen, as `point`
    seen = used & np.isfinite(size)
    left = np.where(size > LEFT_SIGMAS, size, 0.0) - LEFT_BY_NOISE
    light = sums(seen, rest.power[c] * rest.point[c] * left)
    points = seen & (size > MISFIT_SIGMAS)
    at = np.where(owner < 0, n_sources + 1, owner)[points]
    np.maximum.at(light, at, (size * rest.point[c])[points])
    return excess, chi2, np.maximum(light, 0.0)


def chi2_excess(chi2, n):
    """Excess [sigma] of chi2 per pixel over TRUSTED_CHI2, of n pixels of independent noise.

    The cube root of chi2 / n is nearly normal, with mean 1 - 2 / 9n and variance 2 / 9n (Wilson &
    Hilferty 1931, PNAS 17, 684): from 10 pixels on, noise exceeds 5 sigma once in 3e6.
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


def _observed_flux(result, remainders):
    """The `flux` of Misfit."""
    found, error = np.zeros((2, len(result.sources), len(result.channels)))
    channels = result.channel_slices()
    for rendered, left, part in zip(result.rendered, remainders, channels, strict=True):
        for i, c in enumerate(result.components):
            image = rendered.images[i] * left.used[:, *rendered.window(i)]
            found[c.source, part] += c.spectrum[part] * image.sum((1, 2))
    for i, c in enumerate(result.components):
        error[c.source] += np.sqrt(np.maximum(result.covariance[:, i, i], 0)) * c.morphology.sum()
    return np.maximum(np.maximum(found, error), 1e-300)
