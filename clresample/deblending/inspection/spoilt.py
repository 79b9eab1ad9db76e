"""Finds invalid pixels: saturated ones, cosmic rays, hot pixels."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, label, maximum_filter

from .psf_samples import pair_ratios

# [sigma] Smallest brightness of a plateau: noise in images of integers has faint plateaus.
FLAT_SIGMAS = 20.0
# Smallest number of connected pixels of one value in a plateau, and the same for images of
# integers, where bright pixels can be equal by chance.
FLAT_PIXELS, FLAT_INTEGERS = 3, 5
# [sigma] Plateaus of which gains and flat fields have made the values unequal: smallest brightness,
# largest depth of a pixel below the top, and smallest depth of this part of the pixels that touch
# it, below its lowest one. Of 11,340 stars and galaxies of FWHM 2 to 12 px none has such a plateau;
# with 50 and 3, 26 of as many others have one, all under PSFs of 6 px and more.
EVEN_SIGMAS, EVEN_DEPTH, EDGE_DEPTH, EDGE_PART = 100.0, 1.5, 10.0, 0.8
# [px] Margin around saturated pixels, into which charge spreads.
GROW_PX = 2
# [sigma] Not reached by 1e6 pixels of noise.
SHARP_SIGMAS = 6.0
# Smallest number of pixels of a track outside of sources' cores, smallest ratio of the pixels'
# scatters along and across it, and the largest gap in it [px]. The cores of 46 of 150 stars up to
# 1.7 times narrower than their PSF are taken for tracks without the first two, and none with them.
TRACK_PIXELS, TRACK_RATIO, GAP_PX = 3, 4.0, 4
# Uncertainty of a pixel in units of the brightest pixel nearby: PSFs are accurate to a few percent.
NEIGHBOUR_PART = 0.05


def saturated(image) -> np.ndarray:
    """Saturated pixels (C, My, Mx) bool of an InspectedImage, and those within 2 px of them.

    Those at or above the observation's saturation, where it has one, and flat tops: connected
    bright pixels of one value, exactly or within the noise, brighter than all that touch them.
    """
    return saturated_pixels(image.observation, image.significance, image.usable)


def saturated_pixels(observation, significance, usable) -> np.ndarray:
    """Saturated pixels (C, My, Mx) bool of an observation.

    significance (C, My, Mx) [sigma]: data in units of the noise
    usable (C, My, Mx): bool, pixels with a weight
    """
    found = np.zeros(usable.shape, bool)
    limit = getattr(observation, "saturation", None)
    if limit is not None:
        limits = np.broadcast_to(np.asarray(limit, float), len(found))
        with np.errstate(invalid="ignore"):  # NaN: a channel without a limit
            found |= usable & (observation.data >= limits[:, None, None])
    bright = significance > FLAT_SIGMAS
    for c in np.flatnonzero(bright.any(axis=(1, 2))):
        data, weights = observation.data[c], observation.weights[c]
        found[c] |= _flat_tops(data, bright[c]) | _even_tops(data, weights, significance[c])
    if not found.any():
        return found
    ring = np.ones((1, 3, 3), bool)
    return binary_dilation(found, ring, iterations=GROW_PX)


def grown(pixels) -> np.ndarray:
    """Pixels (C, My, Mx) bool and their eight neighbours, to which charge spreads."""
    return binary_dilation(pixels, np.ones((1, 3, 3), bool))


def tracks(sharp, cores) -> np.ndarray:
    """Finds lines among sharp pixels (C, My, Mx) bool, with the pixels in their gaps.

    Where a track crosses a source, pixels are less sharp. Rays are lines of pixels that are sharper
    than the PSF; so is the core of a star whose PSF is too wide: lines with fewer than TRACK_PIXELS
    outside of the cores (My, Mx) of sources are left out.
    """
    found = np.zeros_like(sharp)
    for c in np.flatnonzero(sharp.sum(axis=(1, 2)) >= TRACK_PIXELS):
        joined = binary_dilation(sharp[c], np.ones((3, 3), bool), iterations=GAP_PX // 2)
        groups, n = label(joined, np.ones((3, 3), bool))
        for k in range(1, n + 1):
            pixels = np.argwhere(sharp[c] & (groups == k))
            if np.count_nonzero(~cores[*pixels.T]) < TRACK_PIXELS:
                continue
            middle = pixels.mean(axis=0)
            _, axes = np.linalg.eigh(np.cov(pixels.T, bias=True))
            across, along = ((pixels - middle) @ axes).T
            if np.std(along) < TRACK_RATIO * np.std(across):
                continue
            steps = np.arange(along.min(), along.max() + 0.5, 0.5)
            line = np.rint(middle + steps[:, None] * axes[:, 1]).astype(int)
            inside = ((line >= 0) & (line < sharp.shape[1:])).all(axis=1)
            found[c, *line[inside].T] = True
            found[c, *pixels.T] = True
    return found


def _flat_tops(data, bright):
    """Plateaus (My, Mx) bool of an image among its bright pixels."""
    found = np.zeros(data.shape, bool)
    equal = np.zeros(data.shape, bool)
    down = bright[1:] & (data[1:] == data[:-1])
    right = bright[:, 1:] & (data[:, 1:] == data[:, :-1])
    if down.sum() + right.sum() < FLAT_PIXELS - 1:
        return found
    equal[1:] |= down
    equal[:-1] |= down
    equal[:, 1:] |= right
    equal[:, :-1] |= right
    values = data[bright]
    whole = bool((values == np.rint(values)).all())
    least = FLAT_INTEGERS if whole else FLAT_PIXELS
    for value in np.unique(data[equal]):
        groups, n = label(equal & (data == value))
        for k in range(1, n + 1):
            group = groups == k
            if group.sum() < least:
                continue
            around = binary_dilation(group, np.ones((3, 3), bool)) & ~group
            if not (data[around] > value).any():
                found |= group
    return found


def _even_tops(data, weights, significance):
    """Plateaus (My, Mx) bool of an image within the noise, with steep edges; see EVEN_SIGMAS."""
    found, ring = np.zeros(data.shape, bool), np.ones((3, 3), bool)
    for top in np.argwhere((significance > EVEN_SIGMAS) & (maximum_filter(data, 3) == data)):
        sigma = weights[*top] ** -0.5
        even = data >= data[*top] - EVEN_DEPTH * sigma
        if np.count_nonzero(even[tuple(slice(max(0, i - 1), i + 2) for i in top)]) < FLAT_PIXELS:
            continue
        groups, _ = label(even, ring)
        group = groups == groups[*top]
        around = data[binary_dilation(group, ring) & ~group]
        deep = around < data[group].min() - EDGE_DEPTH * sigma
        if group.sum() >= FLAT_INTEGERS and deep.mean() >= EDGE_PART:
            found |= group
    return found


def sharper_than_psf(image) -> np.ndarray:
    """Pixels (C, My, Mx) bool of an InspectedImage that are sharper than its PSF permits.

        kappa v > v_up + v_down + 6 sigma + uncertainty of the PSF, or the same along x

    v, sigma: light of a pixel, and the noise of these three; kappa: `psf_samples.pair_ratios`. No
    pixel is selected if equally many pixels are equally negative, because the noise is then larger
    than the weights imply. Pixels beside unusable ones and on the edge are not selected.
    """
    z, v, variance, usable = image.significance, image.brightness, image.variance, image.usable
    found = np.zeros(z.shape, bool)
    kappa = pair_ratios(image.observation.psf)
    c, y, x = np.nonzero(z[:, 1:-1, 1:-1] > SHARP_SIGMAS)
    y, x, rest, inner = y + 1, x + 1, [], []
    for axis, (dy, dx) in enumerate(((1, 0), (0, 1))):
        before, after = (c, y - dy, x - dx), (c, y + dy, x + dx)
        pair, own = np.maximum(v[before] + v[after], 0), kappa[c, axis]
        noise = np.sqrt(own**2 * variance[c, y, x] + variance[before] + variance[after])
        rest.append(own * v[c, y, x] - pair - SHARP_SIGMAS * noise)
        inner.append(usable[before] & usable[after])
    sharp = np.max(rest, axis=0) > 0
    if not sharp.any() or (z < -SHARP_SIGMAS).sum() > sharp.sum() / 4:
        return found
    excess, sure, at = (np.array(v)[..., sharp] for v in (rest, inner, (c, y, x)))
    near = [v[k, max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3].max() for k, i, j in at.T]
    found[*at] = (sure & (excess > NEIGHBOUR_PART * np.array(near))).any(axis=0)
    return found
