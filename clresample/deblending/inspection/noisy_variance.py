"""Smooths variances that follow the noise of the data they belong to."""

from __future__ import annotations

import math

import numpy as np

from ...sky.observation import with_weights
from ...sky.psf import SIGMAS_A_FWHM
from .filled import without_filled

# [1] Smallest correlation of the deviations of variance and data from their neighbours, and [sigma]
# smallest bias of a pixel's flux by it, that are mended: the sum over 100 pixels is off by half of
# its error. Sky of 400 counts has 0.05, variances without the data's noise less than 0.005.
MIN_CORRELATION, MIN_BIAS = 0.3, 0.05
MIN_PIXELS = 300  # correlations then have errors of 0.06
# Number of blocks of counts of 0 in an image by chance that are taken for gaps, and [px] the side
# of cells in which these counts are a fraction of all.
BY_CHANCE, CELL_PX = 0.01, 15
CLIP = 4.0  # [sigma] Pixels that deviate more are sources or defects.
# Part of a Gaussian within these sigmas, by which sigma is found: the median of counts may be 0.
WITHIN, WITHIN_SIGMAS = 0.9, 1.645
# Width of the Gaussian mean at sources, in that of the PSF (a point's peak keeps 0.6), and of that
# elsewhere, whose noise in images of a few counts would make weights unequal; at least [px].
NARROW, WIDE, MIN_WIDTH_PX = 0.7, 3.0, 0.7
LIGHT_SIGMAS = 3.0  # of the narrow mean above the wide one, from which a source is there
# Differences of a pixel and its neighbours that are 0 of light without second derivatives along y
# or x. Those from the mean of four hold curved light too: images of 60 stars in 64 pixels, with
# their right variance, had a line in 8 of 8.
ROUGHNESS = np.outer([1, -2, 1], [1, -2, 1]) / 6
AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]) / 8


def prepared(observations) -> tuple[tuple, list[list[str]]]:
    """Observations as they are searched and fitted, and lines about what was changed in each.

    Pixels without data are masked, by `without_filled`, and variances are `with_smooth_variances`.
    """
    observations, filled = without_filled(observations)
    observations, smoothed = with_smooth_variances(observations)
    return observations, [a + b for a, b in zip(filled, smoothed, strict=True)]


def with_smooth_variances(observations) -> tuple[tuple, list[list[str]]]:
    """The observations with variances that do not follow their noise, and lines about them.

    A pixel that is low by its noise has too small a variance if that was made from its own counts,
    and too large a weight: fluxes are too low by cov(data, variance) / variance a pixel. Where dark
    pixels show that, variances are replaced by means over their neighbours.
    Observations without such variances are returned as they are.
    """
    made, lines = [], []
    for o in observations:
        seen, more = o.weights > 0, []
        if o.n_invalid:
            dark = np.stack([_counts_of_0(*pair) for pair in zip(o.data, seen, strict=True)])
            if np.count_nonzero(~seen) <= o.n_invalid:
                seen |= dark
            elif dark.any():
                more = _left_out_lines(o, dark)
        variance = np.divide(1, o.weights, out=np.zeros(seen.shape), where=o.weights > 0)
        biases = [_bias(*channel) for channel in zip(o.data, variance, seen, strict=True)]
        wrong = np.flatnonzero(biases)
        if len(wrong):
            weights = o.weights.copy()
            for c in wrong:
                width = o.psf.fwhm_px[c] / SIGMAS_A_FWHM
                weights[c] = _smooth(variance[c], seen[c], max(NARROW * width, MIN_WIDTH_PX))
            o = with_weights(o, weights)
        made.append(o)
        lines.append((_lines(o, biases) if len(wrong) else []) + more)
    return tuple(made), lines


def _lines(o, biases):
    some = ", ".join(f"{b:.2g} sigma ({n})" for b, n in zip(biases, o.channels, strict=True) if b)
    return [
        "the variance follows the noise of the data itself, as if made from its own counts: "
        f"fluxes would be too low by {some} a pixel; its mean over neighbouring pixels is taken, "
        "and errors are less certain; give a variance from a smoothed image or a model"
    ]


def _left_out_lines(o, dark):
    """A message about counts of 0, (C, My, Mx), that have no weight."""
    pairs = zip(o.channels, dark.mean(axis=(1, 2)), strict=True)
    some = ", ".join(f"{100 * part:.0f} % ({name})" for name, part in pairs if part)
    return [
        "pixels darker than all others have no weight, as if of 0 counts and a variance of 0: "
        f"{some} of all; fluxes are too high without them; give a variance from a smoothed image "
        "or a model"
    ]


def _counts_of_0(data, seen):
    """Selects pixels (My, Mx) without a weight that are counts of 0, whose variance is 0.

    They are darker than all others, and not in blocks that their fraction does not explain, such as
    gaps, nor beside masked pixels that are not dark. seen (My, Mx): those with a weight
    """
    from scipy.ndimage import binary_dilation, binary_opening, uniform_filter

    dark = ~seen & (data < data[seen].min(initial=np.inf))
    if not (dark.any() and seen.any()):
        return np.zeros_like(dark)
    fraction = dark.sum() / (dark | seen).sum()
    side = math.ceil(math.sqrt(math.log(dark.size / BY_CHANCE) / -math.log(fraction)))
    gaps = binary_opening(dark, np.ones((side, side)))
    dark &= ~binary_dilation(gaps | (~seen & ~dark), np.ones((3, 3)))
    beside = (dark[1:] & dark[:-1]).sum() + (dark[:, 1:] & dark[:, :-1]).sum()
    # each has two more neighbours, by chance, in its row and column; single columns have as many
    most = 2 * uniform_filter(dark.astype(float), CELL_PX).max() + MIN_CORRELATION
    if dark.sum() < MIN_PIXELS or beside > most * dark.sum():
        return np.zeros_like(dark)
    return dark


def _bias(data, variance, seen):
    """Bias of a pixel's flux by its variance [sigma], towards zero; 0 if not significant.

    data, variance, seen (My, Mx)
    """
    from scipy.ndimage import convolve

    if not seen.any() or np.ptp(variance[seen]) <= 1e-6 * variance.max():
        return 0.0
    inner = seen & (convolve(seen.astype(float), AROUND, mode="constant") > 0.99)
    if np.count_nonzero(inner) < 2 * MIN_PIXELS:
        return 0.0
    data = np.where(seen, data, 0.0)
    around = convolve(data, AROUND, mode="constant")
    dark = inner & (around <= np.median(around[inner]))
    d, v = (convolve(image, ROUGHNESS, mode="constant")[dark] for image in (data, variance))
    kept = np.abs(d) < CLIP * _scatter(d)
    if np.count_nonzero(kept) < MIN_PIXELS or not v[kept].any():
        return 0.0
    (own, both), (_, other) = np.cov(d[kept], v[kept])
    level = convolve(variance, AROUND, mode="constant")[dark]
    bias = both / (np.median(level) or level.mean() or variance[dark].mean()) ** 1.5
    # a right variance follows light, of which d holds what it has more than noise
    by_light = max(1 - variance[dark].mean() / own, 0)
    correlated = both**2 > (MIN_CORRELATION**2 + by_light) * own * other
    return float(bias) if correlated and bias > MIN_BIAS else 0.0


def _scatter(values):
    """Standard deviation of values (n,) without outliers; also of counts that are mostly 0."""
    size = np.abs(values)
    return np.quantile(size, WITHIN) / WITHIN_SIGMAS or size.max()


def _smooth(variance, seen, width):
    """Weights (My, Mx) of variances averaged over neighbours with a Gaussian `width` [px]."""
    narrow, wide = (_around(variance, seen, w) for w in (width, WIDE * width / NARROW))
    excess = narrow - wide
    variance = np.where(excess > LIGHT_SIGMAS * _scatter(excess[seen]), narrow, wide)
    return np.divide(1, variance, out=np.zeros(variance.shape), where=seen & (variance > 0))


def _around(values, seen, width):
    """Gaussian means of the other pixels `seen` about each, which do not know its own noise."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    n = int(4 * width + 1)
    own = gaussian_filter1d(np.eye(1, 2 * n + 1, n)[0], width)[n] ** 2
    total, share = (
        gaussian_filter(v, width, mode="constant") - own * v
        for v in (np.where(seen, values, 0.0), seen.astype(float))
    )
    return np.divide(total, share, out=values.copy(), where=share > 1e-3)
