"""Noise of source-free pixels, compared with what weights and `noise` say of it."""

from __future__ import annotations

import numpy as np

from ...sky.noise import second_differences
from .levels import SIGMAS_A_MAD

# [1] Smallest correlation of neighbouring pixels that is reported. In 280 channels of simulated
# white noise it is 0.09 at most, 0.27 to 0.34 drizzled, 0.42 to 0.49 resampled by Lanczos, and 0.21
# to 0.31 in coadds of HSC.
MIN_CORRELATION = 0.15
# [1] The same of means over blocks, over that of white noise: 1.2 in 95 % of these channels. It
# is less where light that is not smooth in FAR_PX makes pixels alike.
MIN_BLOCK_SCATTER = 1.2
# [1] The correlation of neighbouring second differences, which light that is smooth does not have:
# -2/3 in white noise, with an error of 0.7 / sqrt(pixels), and -0.58 and more in resampled noise of
# a correlation of 0.16 and more.
WHITE_DIFFERENCES = -0.62
# [1] The same for the scatter of pixels, over that of the weights, and its inverse: 0.92 to 1.08 in
# these channels.
MAX_RATIO = 1.25
# Noise of parts of an image: the median of the N_NEAR nearest blocks, without pixels further than
# UNEVEN_CLIP, and the ratio of its quantiles UNEVEN_PARTS that is reported, of at least MIN_UNEVEN
# pixels. It is at most 1.15 in 36 clean simulated images, 1.4 in stamps with a wide galaxy, and 1.7
# and 1.8 in two of 147 cutouts of fields, of 1000 and 2300 pixels, by light of their neighbours.
N_NEAR, UNEVEN_CLIP, UNEVEN_PARTS, MIN_UNEVEN, MAX_UNEVEN = 9, 10.0, (0.1, 0.9), 5000, 1.6
# Smallest number of pixels: their scatter then has an error of 5 %; of pixels for correlations,
# which then have errors of 0.02.
MIN_PIXELS, MIN_CORRELATED_PIXELS = 200, 1000
# [px] Distance at which noise of resampled images is no longer correlated.
FAR_PX = 8
# [sigma] Pixels that deviate more are faint sources or defects.
CLIP = 4.0


def noise_lines(image, sky) -> list[str]:
    """Messages about correlated noise that is not declared, and about wrong weights.

    image: InspectedImage; sky: its SkyLevel, whose blocks are used
    """
    values, o = image.significance, image.observation
    pixels = sky.blocks.on_pixels(sky.dark, values.shape) & image.usable
    correlation, scatter = np.full((2, len(values)), np.nan)
    n_pixels = pixels.sum(axis=(1, 2))
    counts = np.maximum(sky.blocks.sums(pixels.astype(np.float32)), 1)
    smooth = sky.blocks.sums(np.where(pixels, values, 0)) / counts
    local = values - sky.blocks.on_pixels(smooth, values.shape)
    for c in np.flatnonzero(n_pixels >= MIN_PIXELS):
        own = _scatter(local[c][pixels[c]])
        if sky.block_scatter[c] > sky.blocks.side * max(own, 1):
            continue  # light: means over blocks of noise, however alike its pixels, scatter less
        if n_pixels[c] >= MIN_CORRELATED_PIXELS and not _is_white(values[c], pixels[c]):
            correlation[c] = _correlation(values[c], pixels[c])
        # that of the blocks' means is of smooth noise, or of light that is brighter than the noise
        scatter[c] = max(own, min(np.hypot(own, sky.block_scatter[c] / sky.blocks.side), 1))
    lines = _uneven_lines(local, pixels, sky.blocks, o.channels)
    correlated = (correlation > MIN_CORRELATION) & (sky.block_scatter > MIN_BLOCK_SCATTER)
    if o.noise is None and correlated.any():
        side, ratio = sky.blocks.side, np.median(sky.block_scatter[correlated])
        lines.append(
            "the noise of neighbouring pixels is correlated: by "
            f"{_parts(o.channels, correlation, correlated)}; means over {side} x {side} pixels "
            f"scatter {ratio:.2g} times as much as of white noise, and errors of fluxes are too "
            'small by about as much; give noise="estimate", or what is known of it'
        )
    wrong = (scatter > MAX_RATIO) | (scatter < 1 / MAX_RATIO)
    if wrong.any():
        lines.append(
            "pixels without a source do not scatter as the weights say: by "
            f"{_parts(o.channels, scatter, wrong)} times that; errors of fluxes are wrong by about "
            "as much, and chi2 by its square; scale weights or variance, unless faint sources fill "
            "the image"
        )
    return lines


def _uneven_lines(local, pixels, blocks, channels):
    """A message about noise that differs between parts of an image, in units of the weights'.

    local (C, My, Mx): pixels less the mean of their block; pixels (C, My, Mx): bool, those used
    """
    counts = blocks.sums(pixels.astype(float))
    squares = blocks.sums(np.where(pixels, np.minimum(local**2, UNEVEN_CLIP**2), 0.0))
    ratio = np.ones(len(local))
    for c in np.flatnonzero(counts.sum(axis=1) >= MIN_UNEVEN):
        used = counts[c] > blocks.side**2 / 2
        centers = blocks.centers[used]
        away = ((centers[:, None] - centers) ** 2).sum(axis=-1)
        near = np.argsort(away, axis=1, kind="stable")[:, :N_NEAR]
        scatter = np.sqrt(np.median((squares[c] / np.maximum(counts[c], 1))[used][near], axis=1))
        low, high = np.quantile(scatter, UNEVEN_PARTS)
        ratio[c] = high / max(low, 1e-3)
    uneven = ratio > MAX_UNEVEN
    if not uneven.any():
        return []
    return [
        "the noise differs between parts of the image, unlike the weights: it scatters by "
        f"{_parts(channels, ratio, uneven)} times as much in some parts as in others; errors are "
        "wrong there, and noise may be taken for sources; give a variance map"
    ]


def _scatter(values):
    """Standard deviation of values (n,) without outliers; also of integers, unlike by medians."""
    away = np.abs(values)
    return values[away < CLIP * max(SIGMAS_A_MAD * np.median(away), 1)].std()


def _correlation(values, pixels):
    """Correlation of neighbouring pixels (My, Mx), less that at FAR_PX, which smooth light has."""
    deviations = values - np.median(values[pixels])
    kept = _without_outliers(deviations, pixels)
    return lag_correlation(deviations, kept, 1) - lag_correlation(deviations, kept, FAR_PX)


def _is_white(values, pixels):
    """Returns True if second differences of pixels (My, Mx) are those of white noise."""
    differences, whole = second_differences(values, pixels)
    if not whole.any():
        return False
    kept = _without_outliers(differences, whole)
    return lag_correlation(differences, kept, 1) < WHITE_DIFFERENCES


def _without_outliers(deviations, pixels):
    """Selects those of the pixels (My, Mx) that deviate by less than CLIP."""
    away = np.abs(deviations)
    return pixels & (away < CLIP * SIGMAS_A_MAD * np.median(away[pixels]))


def lag_correlation(deviations, kept, lag):
    """Correlation of deviations (My, Mx) with those `lag` pixels away, of the pixels kept alone."""
    deviations = np.where(kept, deviations, 0)
    power = np.vdot(deviations, deviations) / max(np.count_nonzero(kept), 1)
    both, sums = 0, 0.0
    for one, other in ((np.s_[lag:], np.s_[:-lag]), (np.s_[:, lag:], np.s_[:, :-lag])):
        both += np.count_nonzero(kept[one] & kept[other])
        sums += np.vdot(deviations[one], deviations[other])
    return sums / max(both * power, 1e-30)


def _parts(channels, values, chosen):
    """Values (C,) of the channels chosen, in words."""
    pairs = zip(channels, values, chosen, strict=True)
    return ", ".join(f"{value:.2g} ({name})" for name, value, on in pairs if on)
