"""Level of the sky in the pixels of an observation that hold no source, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Blocks along the longer side of an image: enough to leave many between the sources, each large
# enough for its mean to be known better than a pixel.
N_BLOCKS = 16
MIN_BLOCK_PX = 3
# Blocks without a source that a level needs: of fewer, their scatter is not known to a factor of 2.
MIN_BLOCKS = 8
# [FWHM of the PSF] Blocks whose centre is nearer to a source hold its light.
NEAR_SOURCE = 1.5
# [sigma] Blocks further from the level and the wings hold sources that nobody listed, or defects.
CLIP = 3.0
N_ROUNDS = 4
# Median |x| of a unit Gaussian, inverted.
SIGMAS_A_MAD = 1.4826
# Quarter of the blocks below which the level is looked for at first: sources fill most of a blend.
LOW = 0.25


@dataclass(frozen=True, eq=False)
class SkyLevel:
    """Level of the sky in each channel of an observation.

    level (C,) [counts]: of source-free pixels, half of the wings' light in them taken off
    error (C,) [counts]: from the scatter of blocks of pixels, correlated noise included, and half
        of the wings' light; infinite where too few pixels are free of sources
    n_pixels (C,): in these blocks
    """

    level: np.ndarray
    error: np.ndarray
    n_pixels: np.ndarray


def sky_level(image) -> SkyLevel:
    """The SkyLevel of an Image.

        mean of block b = level + wing T_b,    T_b = sum_s f_s / (r_sb^2 + r_0^2),    wing >= 0

    fitted to the means of blocks of pixels, those off by over 3 sigma left out. f_s is the light at
    source s, r its distance, r_0 the PSF's FWHM. Profiles of galaxies fall by r^-2 or faster where
    their wings meet the noise, so that the level lies between that fit and the blocks' mean: it is
    half way, and half of their difference is part of its error.
    """
    means, counts, centers, side = _blocks(image)
    n_channels, n_blocks = means.shape
    white = image.sigma[:, None] / np.sqrt(np.maximum(counts, 1))
    known = 2 * counts > side**2
    free = _free(image, centers)
    if free.sum() >= max(MIN_BLOCKS, n_blocks // 4):
        known &= free
    enough = known.sum(axis=1) >= MIN_BLOCKS
    if not enough.any():
        return _unknown(n_channels)
    wings = _wings(image, means, centers)
    masked = np.where(known, means, np.inf)
    order = np.sort(masked, axis=1)
    low = np.take_along_axis(order, (LOW * known.sum(axis=1)).astype(int)[:, None], 1)
    low = np.where(enough[:, None], low, 0.0)
    kept = known & (means < low + (CLIP + 1) * white)
    for _ in range(N_ROUNDS):
        level, wing, variance = _fitted(means, wings, white, kept)
        rest = (means - level[:, None] - wing[:, None] * wings) / white
        spread = _spread(rest, kept)
        kept = known & (np.abs(rest) < CLIP * spread[:, None])
    enough &= kept.sum(axis=1) >= MIN_BLOCKS
    number = np.maximum(kept.sum(axis=1), 1)
    half = wing * (wings * kept).sum(axis=1) / number / 2
    error = np.sqrt(variance * spread**2 + half**2)
    return SkyLevel(
        np.where(enough, level + half, 0.0),
        np.where(enough, error, np.inf),
        (counts * kept).sum(axis=1) * enough,
    )


def _unknown(n_channels):
    """The SkyLevel of channels without blank pixels."""
    zeros = np.zeros(n_channels)
    return SkyLevel(zeros, zeros + np.inf, zeros.astype(int))


def _blocks(image):
    """Means (C, B) [counts] and numbers (C, B) of usable pixels in blocks, the blocks' centres
    (B, 2) [px] and their side [px]."""
    data = image.observation.data
    n_y, n_x = data.shape[1:]
    side = max(MIN_BLOCK_PX, -(-max(n_y, n_x) // N_BLOCKS))
    if min(n_y, n_x) < side:
        return np.zeros((len(data), 0)), np.zeros((len(data), 0)), np.zeros((0, 2)), side
    starts = [np.arange(0, n - side + 1, side) + n % side // 2 for n in (n_y, n_x)]
    inner = tuple(slice(s[0], s[-1] + side) for s in starts)

    def sums(values):
        cut = values[(slice(None), *inner)]
        shape = len(cut), len(starts[0]), side, len(starts[1]), side
        return np.einsum("cyixj->cyx", cut.reshape(shape)).reshape(len(cut), -1)

    counts = sums(image.usable.astype(np.float64))
    total = sums(np.where(image.usable, data, 0.0))
    centers = np.stack(np.meshgrid(*(s + (side - 1) / 2 for s in starts), indexing="ij"), axis=-1)
    return total / np.maximum(counts, 1), counts, centers.reshape(-1, 2), side


def _free(image, centers):
    """Which blocks (B,) lie further from all sources than the PSF is wide."""
    places = image.places[np.isfinite(image.places).all(axis=1)]
    if not len(places):
        return np.ones(len(centers), bool)
    squares = ((centers[:, None] - places) ** 2).sum(axis=-1)
    return squares.min(axis=1) > (NEAR_SOURCE * image.width_px) ** 2


def _wings(image, means, centers):
    """Light of wings (C, B) falling as r^-2 about the sources, as bright as the blocks there; its
    largest value is 1, or it is 0 without sources."""
    places = image.places[image.inside]
    if not len(places):
        return np.zeros_like(means)
    squares = ((centers[:, None] - places) ** 2).sum(axis=-1)  # (B, S)
    light = means[:, squares.argmin(axis=0)] - np.median(means, axis=1, keepdims=True)
    light = np.maximum(light, image.sigma[:, None] * 1e-3)  # a source nobody can see has no wings
    wings = light @ (1 / (squares + image.width_px**2)).T
    return wings / wings.max(axis=1, keepdims=True)


def _fitted(means, wings, white, kept):
    """Level and wing (C,) by least squares with wing >= 0, and the level's variance (C,), of
    blocks with noise `white`."""
    weight = kept / white**2
    a, b, c = weight.sum(1), (weight * wings).sum(1), (weight * wings**2).sum(1)
    d, e = (weight * means).sum(1), (weight * wings * means).sum(1)
    a = np.maximum(a, 1e-300)
    determinant = a * c - b * b
    solvable = determinant > 1e-6 * a * c
    wing = np.where(solvable, (a * e - b * d) / np.where(solvable, determinant, 1.0), 0.0)
    up = wing > 0
    wing = np.where(up, wing, 0.0)
    variance = np.where(up & solvable, c / np.where(solvable, determinant, 1.0), 1 / a)
    return (d - wing * b) / a, wing, variance


def _spread(rest, kept):
    """Scatter (C,) of the kept blocks, in units of white noise, at least 1."""
    order = np.sort(np.where(kept, np.abs(rest), np.inf), axis=1)
    middle = np.take_along_axis(order, kept.sum(axis=1)[:, None] // 2, 1)[:, 0]
    return np.maximum(1.0, SIGMAS_A_MAD * np.where(np.isfinite(middle), middle, 1.0))
