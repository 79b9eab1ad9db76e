"""Finds pixels without data, filled with a number: zeros beyond an edge or in chip gaps.

Noise of floating-point numbers gives no value to many neighbouring pixels. So large blocks of one
exact value in such noise are no data. Images of integers or of other steps, and images without
noise, have such blocks too, so that nothing is found in them.
"""

from __future__ import annotations

import numpy as np

# Smallest number of connected pixels of one value in a block: a part of a dead column, or 3 x 3.
MIN_BLOCK = 8
# Largest number of values that are searched for blocks, the most frequent ones.
MAX_VALUES = 16
# Number of pixels whose values are compared, and the smallest one.
SAMPLE, MIN_SAMPLE = 2000, 32
# [1] Largest fraction of them that share their value with others. It is 0 for noise in
# float32, 0.02 and 0.22 on a sky of 1e3 and 1e4 sigma, and 0.97 in steps of a tenth of the noise.
MAX_SHARED = 0.05
# [1] Smallest fraction of pixels that are brighter or fainter than both neighbours of their row: in
# white noise it is 2/3, in noise smoothed with a FWHM of 4 px 0.22. On bright galaxies it is less;
# in a model of three sources without noise it is 0.04.
MIN_EXTREMES = 0.1
# [sigma] Smallest median difference of neighbours where weights are known: 0.96 in white noise,
# 0.27 in noise smoothed with a FWHM of 4 px. Rounding errors of models are far below it.
MIN_STEP = 0.05


def filled_pixels(image, usable, weights=None) -> np.ndarray:
    """Pixels without data (Ny, Nx) bool of an image, which have the exact value of a block.

    image (Ny, Nx) or (n,); usable: bool of the same shape, the pixels that are neither masked nor
        NaN
    weights: of the same shape, None where unknown
    """
    none = np.zeros(image.shape, bool)
    equal = _beside_equal(image, usable)
    if np.count_nonzero(equal) < MIN_BLOCK:
        return none
    blocks, fills = _blocks(image, equal)
    if not fills or not is_noise(image, usable & ~blocks, weights):
        return none
    return usable & np.isin(image, fills)


def is_noise(image, chosen, weights=None) -> bool:
    """Returns True if the pixels `chosen` of an image are noise of floating-point numbers.

    These rarely share values, every other one is an extreme of its row, and they differ by what
    their weights, where known, say. image (Ny, Nx) or (n,)
    """
    values = image[chosen]
    some = values[:: max(1, values.size // SAMPLE)]
    if some.size < MIN_SAMPLE or np.unique(some).size < (1 - MAX_SHARED) * some.size:
        return False
    steps = np.diff(image, axis=-1)
    if weights is not None:
        sizes = np.abs(steps)[chosen[..., 1:] & chosen[..., :-1]]
        if not sizes.size or np.median(sizes) < MIN_STEP / np.sqrt(np.median(weights[chosen])):
            return False
    rises = steps > 0
    inner = chosen[..., :-2] & chosen[..., 1:-1] & chosen[..., 2:]
    turns = (rises[..., 1:] != rises[..., :-1])[inner]
    return bool(turns.size and turns.mean() > MIN_EXTREMES)


def _beside_equal(image, usable):
    """Usable pixels (Ny, Nx) bool with a usable neighbour of the same value."""
    equal = np.zeros(image.shape, bool)
    for axis in range(image.ndim):
        one, other = ((slice(None),) * axis + (s,) for s in (slice(1, None), slice(-1)))
        pairs = (image[one] == image[other]) & usable[one] & usable[other]
        equal[one] |= pairs
        equal[other] |= pairs
    return equal


def _blocks(image, equal):
    """Blocks of one value (Ny, Nx) bool among pixels by `_beside_equal`, and their values."""
    from scipy.ndimage import label

    blocks, fills = np.zeros(image.shape, bool), []
    values, counts = np.unique(image[equal], return_counts=True)
    order = np.argsort(-counts)[:MAX_VALUES]
    for value in values[order[counts[order] >= MIN_BLOCK]]:
        groups, _ = label(equal & (image == value))
        large = np.bincount(groups.ravel()) >= MIN_BLOCK
        large[0] = False
        if large.any():
            blocks |= large[groups]
            fills.append(value)
    return blocks, fills
