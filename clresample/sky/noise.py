"""Noise of images: weights from a user's arguments, or estimated from the background."""

from __future__ import annotations

import math
import warnings
from statistics import NormalDist

import numpy as np

from .filled import filled_pixels
from .validation.checks import as_float_array, mask_of, split_mask, to_unit


class NoiseWarning(UserWarning):
    """An image whose noise was estimated from its background, or that has no usable pixel."""


# [sigma] Pixels further from the median count as sources; so does one in 370 of pure noise.
CLIP = 3.0
# Each iteration removes at least one pixel; images half covered by sources need 3 to 8.
MAX_ROUNDS = 50
# Smallest number of pixels of a noise estimate: the MAD then has an error of a fifth.
MIN_PIXELS = 32
# Largest data, weights and variances: their squares are far below float64's limit.
LARGEST = 1e100
# [sigma] Largest signal to noise of a pixel: float32 rounds it by 1e5 sigma, and chi2 overflows
# soon above it. Real images reach 1e4.
MAX_SIGMAS = 1e12
# Mean number of pixels of equal value from which an image counts as quantised. 1000 pixels of
# integers with noise of sigma have some 7 sigma values; float images have as many values as pixels.
EQUAL = 4
# Number of pixels for a first test for quantisation, since most images are of floats.
SOME = 2000
# median |x| of a unit Gaussian, untruncated and truncated at CLIP
HALF_WIDTH = NormalDist().inv_cdf(0.75)
HALF_WIDTH_CUT = NormalDist().inv_cdf(0.5 + math.erf(CLIP / math.sqrt(2)) / 4)


def background(image, mask=None) -> tuple[float, float]:
    """Level and standard deviation of an image's background, sources clipped away.

        level = median x,  sigma = MAD / q,  MAD = median |x - level| over |x - level| <= 3 sigma

    iterated, with q = 0.672, the MAD of a unit Gaussian truncated at 3 sigma. It is unbiased for
    white noise. sigma is too large by 2 % if faint wings of sources cover 3 % of the pixels, by a
    third if they cover half, and by 30 to 50 % on a 48 x 58 cutout of a real blend. For correlated
    noise it is the scatter of single pixels. It is 0 if more than half of the pixels are equal.

    image (Ny, Nx); mask (Ny, Nx): True = ignore; NaN and infinite pixels are ignored too, and so
        are pixels without data that are filled with a value (`filled_pixels`)

    The MAD of a quantised image, such as one of integers, would be quantised too. So equal values
    are first spread evenly over their step.
    """
    values, step = _spread_steps(_usable(image, mask))
    level = np.median(values)
    sigma = np.median(np.abs(values - level)) / HALF_WIDTH
    for _ in range(MAX_ROUNDS):
        level = np.median(values)
        distance = np.abs(values - level)
        kept = distance <= CLIP * sigma
        sigma = np.median(distance[kept]) / HALF_WIDTH_CUT
        if kept.all():
            break
        values = values[kept]
    if step and sigma:
        sigma = math.sqrt(max(sigma**2 - step**2 / 12, 0))  # variance added by spreading
    return float(level), float(sigma)


def _spread_steps(values):
    """Values (n,) with equal ones spread evenly over the step to the next value; and the step.

    If few values are equal, or more than half, returns the unchanged values and 0.
    """
    some = values[:: max(1, values.size // SOME)]
    if 2 * np.unique(some).size > some.size:
        return values, 0.0
    steps, counts = np.unique(values, return_counts=True)
    if EQUAL * steps.size > values.size or 2 * counts.max() > values.size:
        return values, 0.0
    step = float(np.median(np.diff(steps)))
    rank = np.arange(values.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(steps, counts) + step * ((rank + 0.5) / np.repeat(counts, counts) - 0.5), step


def noise_sigma(image, mask=None) -> float:
    """Scatter of an image's background by `background`; an error if it is not reliable.

    image (Ny, Nx); mask (Ny, Nx): True = ignore; NaN, infinite and filled pixels are ignored too
    Raises ValueError for fewer than 32 pixels, and where most of those near the level have one
    value.
    """
    values = _usable(image, mask)
    n_usable = values.size
    if n_usable < MIN_PIXELS:
        raise ValueError(
            f"{n_usable} pixels are left to estimate the noise from, {MIN_PIXELS} are needed"
        )
    level, sigma = background(image, mask)
    if not sigma > 0:
        raise ValueError(
            f"{np.count_nonzero(values == level)} of {n_usable} pixels have the same value, "
            f"{level:.6g}, and few others are near it: no noise can be estimated from them"
        )
    return sigma


def sigma_below_zero(image) -> float | None:
    """Scatter of an image with zero sky level, from its negative pixels alone.

        sigma = median |x| / 0.674  over x < 0

    For images mostly covered by sources, which bias `background`; sources have no negative pixels.
    For pure noise its error is larger than that of `background`, because it uses half of the
    pixels, and a sky level other than zero biases it.

    image (...); None where fewer than 32 pixels are negative
    """
    below = image[image < 0]
    return float(np.median(-below)) / HALF_WIDTH if below.size >= MIN_PIXELS else None


def second_differences(image, used):
    """Second differences of an image (Ny, Nx) along both axes, and whether all pixels are used.

    Both (Ny - 2, Nx - 2). Smooth light has none (Immerkaer 1996, CVIU 64, 300).
    """
    along_y = np.s_[:-2], np.s_[1:-1], np.s_[2:]
    along_x = np.s_[:, :-2], np.s_[:, 1:-1], np.s_[:, 2:]
    for low, middle, high in (along_y, along_x):
        image = image[low] - 2 * image[middle] + image[high]
        used = used[low] & used[middle] & used[high]
    return image, used


def _usable(image, mask):
    """The pixels (n,) float64 of an image that are finite, not masked and not filled."""
    image = np.asarray(image, dtype=np.float64)
    good = np.isfinite(image)
    if mask is not None:
        good &= ~np.asarray(mask, dtype=bool)
    return image[good & ~filled_pixels(image, good)]


def weights_from(data, bad, given, mask, channels, unit=None):
    """Weights (C, Ny, Nx), `n_invalid` and messages of an Observation from its arguments.

    data (C, Ny, Nx) float64; bad (C, Ny, Nx) bool: pixels where they are NaN or infinite
    given: weights, variance and mask, as in Observation; None if not passed
    channels (C,): names; unit: of the data, None if they have none

    Warns (NoiseWarning) of noise that is estimated, and of images without any usable pixel. Raises
    ValueError where Observation does, for these.
    """
    weights, variance = given
    if weights is not None and variance is not None:
        raise ValueError("weights and variance are both given: an observation takes one")
    mask, estimates = mask_from(mask, data.shape), []
    if not (_has_gaps("weights", weights, data) or _has_gaps("variance", variance, data)):
        found = _weights_of(data, bad, given, mask, channels, unit, estimates)
    else:
        parts = [
            _weights_of(
                data[c : c + 1],
                bad[c : c + 1],
                (weights and weights[c], variance and variance[c]),
                mask[c : c + 1],
                channels[c : c + 1],
                unit,
                estimates,
            )
            for c in range(len(data))
        ]
        images, counts, messages = zip(*parts, strict=True)
        found = np.concatenate(images), sum(counts), [line for one in messages for line in one]
    if estimates:
        warnings.warn("; ".join(estimates), NoiseWarning, stacklevel=3)
    if found[1] and not found[0].any():  # images that are masked everywhere have none on purpose
        warnings.warn(
            f"no pixel of {', '.join(channels)} has a weight, and nothing can be measured: data, "
            "weights or variance are NaN, infinite or 0 everywhere; check what was read",
            NoiseWarning,
            stacklevel=3,
        )
    return found


def _has_gaps(name, values, data):
    """Returns True if values are a list with one for each channel and None among them."""
    if not isinstance(values, list | tuple) or not any(one is None for one in values):
        return False
    if len(values) != len(data):
        raise ValueError(f"{name} has {len(values)} values, data have {len(data)} channels")
    return True


def _weights_of(data, bad, given, mask, channels, unit, estimates):
    """Like `weights_from`, for values without gaps; adds the estimates to `estimates`."""
    weights, variance = given
    masked, messages = mask, []
    if unit is not None:
        weights = to_unit("weights", weights, unit**-2)
        variance = to_unit("variance", variance, unit**2)
    weights, hidden = split_mask("weights", weights)
    variance, unknown = split_mask("variance", variance)
    for name, more in (("weights", hidden), ("variance", unknown)):
        if more is not None:  # a masked weight means: ignore this pixel
            masked = masked | (_spread(name, more.astype(float), data.shape) > 0)
    if weights is not None:
        weights, no_weight = _checked_weights(weights, data.shape)
    elif variance is not None:
        weights, no_weight = _inverse(variance, data.shape)
    else:
        weights, messages = _estimated(data, bad | masked, channels, unit or "counts")
        estimates += messages
        no_weight = np.zeros_like(bad)
    n_bad = int(np.count_nonzero(~masked & (no_weight | (bad & (weights > 0)))))
    weights = np.where(bad | masked, 0.0, weights)
    _check_range(data, weights)
    messages = list(messages)
    if n_bad:
        messages.append(
            f"{n_bad} of {data.size} pixels have weight 0: no usable data, weight or variance"
        )
    messages += [
        f"channel {channel} has no pixel with a weight"
        for channel, seen in zip(channels, weights.any(axis=(1, 2)), strict=True)
        if not seen
    ]
    return weights, n_bad, messages


def _check_range(data, weights):
    """Raises ValueError if data or weights exceed the numeric range of a fit."""
    light = np.where(weights > 0, np.abs(data), 0.0)
    root, one = np.sqrt(weights), np.ones_like(weights)
    inverse = np.divide(one, weights, out=np.zeros_like(weights), where=weights > 0)
    for name, values, most in (
        ("data", light, LARGEST),
        ("weights", weights, LARGEST),
        ("data in units of their noise", np.minimum(light, LARGEST) * root, MAX_SIGMAS),
        ("variances", inverse, LARGEST),
    ):
        i = np.unravel_index(np.argmax(values), values.shape)
        if not values[i] <= most:
            raise ValueError(
                f"{name} reach {values[i]:.3g} at (channel, y, x) = {tuple(map(int, i))}, more "
                f"than {most:g}: mask such pixels, or take another unit"
            )


def _spread(name, values, shape):
    """Numbers given for each pixel, channel or all at once: (C, Ny, Nx)."""
    if values.shape == shape[:1]:
        return np.broadcast_to(values[:, None, None], shape)
    if values.shape not in ((), shape[1:], shape):
        raise ValueError(f"{name} has the shape {values.shape}, data {shape}")
    return np.broadcast_to(values, shape)


def mask_from(mask, shape):
    """The mask (C, Ny, Nx) bool, True = ignore; all False where none is given."""
    if mask is None:
        return np.zeros(shape, dtype=bool)
    hidden, values = mask_of(mask), np.asarray(getattr(mask, "unmasked", mask))
    if hidden is not None:  # masked elements of a mask count as bad
        values = np.where(hidden, 1, values)
    if values.shape not in (shape[1:], shape):
        raise ValueError(f"mask has the shape {values.shape}, data {shape}")
    if values.dtype != bool and not np.isin(values, (0, 1)).all():
        odd = values[~np.isin(values, (0, 1))].flat[0]
        raise ValueError(
            f"mask must be True (ignore) or False, not {odd}: of a mask with bits, "
            "select those to ignore, for example mask & 5 > 0"
        )
    return np.broadcast_to(values.astype(bool), shape)


def _checked_weights(weights, shape):
    """Weights (C, Ny, Nx), and a mask of those that were NaN."""
    weights = _spread("weights", as_float_array("weights", weights), shape)
    for wrong, what in ((weights < 0, "negative"), (np.isinf(weights), "infinite")):
        if wrong.any():
            raise ValueError(
                f"weights has {np.count_nonzero(wrong)} {what} values, the first at "
                f"(channel, y, x) = {tuple(np.argwhere(wrong)[0].tolist())}: "
                "a weight is an inverse variance, 0 to ignore a pixel"
            )
    lost = np.isnan(weights)
    return np.where(lost, 0.0, weights), lost


def _inverse(variance, shape):
    """Weights (C, Ny, Nx) from variances, and a mask of invalid variances."""
    variance = _spread("variance", as_float_array("variance", variance), shape)
    good = variance >= np.finfo(np.float64).tiny  # the inverse of less may overflow
    return np.divide(1.0, variance, out=np.zeros(shape), where=good), ~good


def _estimated(data, ignored, channels, unit):
    """Estimates weights (C, Ny, Nx) from each channel's own background; also returns messages.

    The messages report the estimates in this unit.
    """
    weights, messages = np.ones(data.shape), []
    for i, channel in enumerate(channels):
        if ignored[i].all():
            continue  # no pixel of it will keep its weight
        try:
            sigma = noise_sigma(data[i], ignored[i])
        except ValueError as error:
            raise ValueError(f"channel {channel}: {error}; give weights or variance") from None
        weights[i] = sigma**-2
        messages.append(
            f"noise of channel {channel} estimated from the background: sigma = {sigma:.4g} {unit}"
        )
    return weights, messages
