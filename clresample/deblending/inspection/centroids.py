"""Distances of the light's centroids from the places of the sources, in every channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.psf import SIGMAS_A_FWHM
from .image import InspectedImage

# [sigma] Sources this bright in a channel have a centroid to a tenth of the PSF's width.
BRIGHT_SIGMAS = 20.0
# [standard deviations of the weight] Half-width of the pixels about a source.
REACH = 2.5
# Smallest ratio of a weighted centroid's shift to the light's: it is a half for light as wide as
# the weight and less for wider light, for which the centroid is uncertain below this ratio.
MIN_RESPONSE = 0.1
# [px] Smallest error of centroids, because of neighbours, structure and errors of the PSF.
FLOOR_PX = 0.03
# Deviation of one source from the others that is its own: a bright star of proper motion is known
# better than all galaxies together. The others are three at least: two agree by chance, as in one
# of 200 clean scenes.
OUTLIER_SIGMAS, MIN_AGREEING = 5.0, 3


@dataclass(frozen=True, eq=False)
class Centroids:
    """Offsets of light from the places of an InspectedImage's bright sources.

    sources (n,): numbers of the sources
    offsets (n, C, 2) [px]: of the light within about the PSF's width, (y, x)
    errors (n, C) [px]: infinite where a channel is too faint
    """

    sources: np.ndarray
    offsets: np.ndarray
    errors: np.ndarray


def centroids(image: InspectedImage) -> Centroids:
    """The Centroids of the brightest sources of an InspectedImage.

        m1 = sum w z r / sum w z,    m2 = sum w z r^2 / (2 sum w z),    offset = m1 / (1 - m2 / s^2)

    z: brightness; r: from the place; w: Gaussian of standard deviation s, that of the PSF. The
    offset is exact for Gaussian light of any width.
    """
    chosen = image.brightest
    width = np.maximum(image.observation.psf.fwhm_px / SIGMAS_A_FWHM, 0.7)  # a pixel's at least
    reach = int(np.ceil(REACH * width.max()))
    y, x, on = image.patches(chosen, reach)
    usable = image.usable[:, y, x] & on
    light, variance = (
        np.where(usable, v[:, y, x], 0) for v in (image.brightness, image.variance)
    )  # (C, n, h, h)
    away = np.stack([y[:, :, 0], x[:, 0]]) - image.places[chosen].T[..., None]  # (2, n, h)
    core = away[0, :, :, None] ** 2 + away[1, :, None] ** 2 <= (width.max() * 1.5) ** 2
    whole = (usable | ~core).all(axis=(2, 3))  # (C, n)
    # the weight is one of y times one of x, and so are its moments
    weight = np.exp(-0.5 * (away[:, None] / width[:, None, None]) ** 2)  # (2, C, n, h)
    powers = np.stack([weight * away[:, None] ** k for k in range(3)], axis=-1)  # (2, C, n, h, 3)
    moments = powers[0].swapaxes(-1, -2) @ light @ powers[1]  # (C, n, 3, 3)
    square = weight[..., None] * powers
    square = square[0].swapaxes(-1, -2) @ variance @ square[1]  # (C, n, 3, 3)
    noise = np.sqrt(square[..., 0, 0])
    total = moments[..., 0, 0]
    good = whole & (total > BRIGHT_SIGMAS * noise)
    total = np.where(good, total, 1.0)
    first = np.stack([moments[..., 1, 0], moments[..., 0, 1]], axis=-1)
    second = (moments[..., 2, 0] + moments[..., 0, 2]) / (2 * total)
    response = 1 - second / (width**2)[:, None]
    good &= response > MIN_RESPONSE
    response = np.where(good, response, 1.0)
    spread = square[..., 2, 0] + square[..., 0, 2]
    error = np.sqrt(spread / 2) / total / response
    error = np.where(good, np.hypot(error, FLOOR_PX), np.inf)
    offsets = first / (total * response)[..., None]
    return Centroids(chosen, offsets.swapaxes(0, 1), error.T)


def over_channels(found) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, 2) and errors (n,) of Centroids from all channels together."""
    weight = found.errors**-2.0
    total = weight.sum(axis=1)
    safe = np.where(total > 0, total, 1.0)
    offsets = np.einsum("nc,ncd->nd", weight, found.offsets) / safe[:, None]
    return offsets, np.where(total > 0, safe**-0.5, np.inf)


def common(offsets, errors) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (2,) of offsets (n, 2) with errors (n,), and its error (2,).

    The error follows from their scatter if that is larger; it is infinite without any. Those
    further than OUTLIER_SIGMAS from the mean of the others are left out, the furthest first, as
    long as MIN_AGREEING remain.
    """
    kept = np.isfinite(errors)
    while kept.sum() > MIN_AGREEING:
        away = np.zeros(len(errors))
        for i in np.flatnonzero(kept):
            others = kept & (np.arange(len(errors)) != i)
            mean, error = _mean_of(offsets[others], errors[others])
            away[i] = (np.abs(offsets[i] - mean) / np.hypot(error, errors[i])).max()
        if away.max() <= OUTLIER_SIGMAS:
            break
        kept[away.argmax()] = False
    return _mean_of(offsets[kept], errors[kept])


def _mean_of(offsets, errors):
    weight = errors**-2.0
    total = weight.sum()
    if not total > 0:
        return np.zeros(2), np.full(2, np.inf)
    mean = weight @ offsets / total
    rest = (weight[:, None] * (offsets - mean) ** 2).sum(axis=0)
    return mean, np.sqrt(np.maximum(1.0, rest / max(len(weight) - 1, 1)) / total)
