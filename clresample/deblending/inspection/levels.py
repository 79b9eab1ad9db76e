"""Level of the sky in the source-free pixels of an observation, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Blocks along the longer side of an image: enough for many blocks between the sources, each large
# enough to average the noise of pixels.
N_BLOCKS = 16
MIN_BLOCK_PX = 3
# Smallest number of source-free blocks: with fewer, their scatter is uncertain by a factor of 2.
MIN_BLOCKS = 8
# [FWHM of the PSF] Blocks whose centre is nearer to a source contain its light.
NEAR_SOURCE = 1.5
# [sigma] Blocks that deviate more from level and wings contain unlisted sources or defects.
CLIP = 3.0
N_ROUNDS = 3
# Median |x| of a unit Gaussian, inverted.
SIGMAS_A_MAD = 1.4826
# Fractions of the source-free blocks, those furthest from the light. The level is fitted in the
# first fraction, where wings are faint; the second is the rim, where they should have ended.
DARK, RIM = 0.5, 0.25
# Powers of the distance by which wings fall. The outskirts of ellipticals (n = 4) fall as r^-2.5 to
# r^-3.5 from 3 to 12 effective radii, and exponential disks faster; the outer two powers are
# bounds.
POWERS = 2.0, 3.0, 4.0


@dataclass(frozen=True, eq=False)
class SkyLevel:
    """Level of the sky in each channel of an observation.

    level (C,) [counts]: of source-free pixels, after subtraction of the sources' wings
    error (C,) [counts]: total error of the level; infinite if too few pixels are free of sources
    wings (C,) [counts]: contribution of the unknown slope of wings to the error, which has the same
        sign in all channels
    rim (C,) [counts]: level of the pixels furthest from the sources, wings included
    rim_error (C,) [counts]: error of the rim; infinite if it is unknown
    """

    level: np.ndarray
    error: np.ndarray
    wings: np.ndarray
    rim: np.ndarray
    rim_error: np.ndarray

    def within(self, error) -> SkyLevel:
        """The SkyLevel with unknown levels replaced by those of the rim, if they are below zero.

        Others become 0, with an error (C,) [counts].
        """
        below = self.rim < -error
        ends = np.isinf(self.error)
        level = np.where(ends & below, self.rim, self.level)
        own = np.where(below, np.minimum(self.rim_error, error), error)
        return replace(self, level=level, error=np.where(ends, own, self.error))


def sky_level(image) -> SkyLevel:
    """The SkyLevel of an InspectedImage.

        mean of block b = level + wing T_b,    T_b = sum_s f_s (r_sb^2 + r_0^2)^(-p/2),    wing >= 0

    fitted with p = 3 to the means of blocks of pixels in the darker half of the image, without
    3-sigma outliers. f_s is the light at source s, r its distance, r_0 the PSF's FWHM. Half of the
    change of the level between p = 2 and 4 is part of its error; the rest follows from the scatter
    of the blocks, which includes correlated noise.
    """
    means, counts, centers, side = _blocks(image)
    n_channels = len(means)
    white = image.sigma[:, None] / np.sqrt(np.maximum(counts, 1))
    wings = _wings(image, means, centers)
    darker = _darker(image, centers, wings[0])
    known = 2 * counts > side**2
    dark = known & (darker < DARK)
    if not (dark.sum(axis=1) >= MIN_BLOCKS).any():
        return SkyLevel(np.zeros(n_channels), *_unknown(n_channels))
    kept, none = dark, np.zeros(n_channels)
    for _ in range(N_ROUNDS):
        level, wing, variance = _fitted(means, wings[1], white, kept)
        model = level[:, None] + wing[:, None] * wings[1]
        spread = _spread(means - model, white, none, kept)
        before, kept = kept, dark & (np.abs(means - model) < CLIP * spread)
        if (kept == before).all():
            break
    scale = (spread / white).max(axis=1)
    steep, shallow = _fitted(means, wings[[0, 2]], white, kept)[0]
    unsure = np.abs(steep - shallow) / 2
    enough = kept.sum(axis=1) >= MIN_BLOCKS
    rim, rim_error = _rim(means, white, known & (darker < RIM))
    return SkyLevel(
        np.where(enough, level, 0.0),
        np.where(enough, np.sqrt(variance * scale**2 + unsure**2), np.inf),
        np.where(enough, unsure, 0.0),
        rim,
        rim_error,
    )


def _unknown(n_channels):
    """Error, wings, rim and its error of channels without blank pixels."""
    zeros = np.zeros(n_channels)
    return zeros + np.inf, zeros, zeros, zeros + np.inf


def _rim(means, white, kept):
    """Mean (C,) of the kept blocks and its error, outliers left out."""
    for _ in range(N_ROUNDS):
        middle = _middle(means, kept)
        spread = _spread(means, white, middle, kept)
        near = kept & (np.abs(means - middle[:, None]) < CLIP * spread)
        if (near == kept).all():
            break
        kept = np.where(near.sum(axis=1, keepdims=True) >= MIN_BLOCKS // 2, near, kept)
    number = kept.sum(axis=1)
    known = number >= MIN_BLOCKS // 2
    number = np.maximum(number, 1)
    error = np.sqrt((spread**2 * kept).sum(axis=1)) / number
    return (means * kept).sum(axis=1) / number, np.where(known, error, np.inf)


def _blocks(image):
    """Means (C, B) [counts] and numbers (C, B) of usable pixels in blocks.

    Also returns the blocks' centres (B, 2) [px] and their side [px].
    """
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


def _darker(image, centers, wings):
    """Rank (B,) of the blocks by the light of wings (C, B) in them, from 0, the darkest, to 1.

    Infinite of those in a source.
    """
    light = (wings / image.sigma[:, None]).sum(axis=0) if len(wings) else np.zeros(len(centers))
    free = np.ones(len(centers), bool)
    places = image.places[np.isfinite(image.places).all(axis=1)]
    if len(places):
        squares = ((centers[:, None] - places) ** 2).sum(axis=-1)
        free = squares.min(axis=1) > (NEAR_SOURCE * image.width_px) ** 2
    rank = np.full(len(centers), np.inf)
    order = np.argsort(light[free], kind="stable")
    rank[np.flatnonzero(free)[order]] = np.arange(len(order)) / max(len(order), 1)
    return rank


def _wings(image, means, centers):
    """Light of wings (3, C, B) [counts] about the sources that fall by each of POWERS.

    Those of the first power are as bright at the sources as the blocks there; 0 without sources.
    """
    places = image.places[image.inside]
    if not len(places) or not len(centers):
        return np.zeros((len(POWERS), *means.shape))
    squares = ((centers[:, None] - places) ** 2).sum(axis=-1)  # (B, S)
    light = means[:, squares.argmin(axis=0)] - np.median(means, axis=1, keepdims=True)
    light = np.maximum(light, image.sigma[:, None] * 1e-3)  # undetected sources have no wings
    core = max(image.width_px, 1.0) ** 2
    return light @ np.exp(-0.5 * np.array(POWERS)[:, None, None] * np.log1p(squares / core).T)


def _fitted(means, wings, white, kept):
    """Level and wing (..., C) by least squares with wing >= 0, and the level's variance (..., C).

    wings (..., C, B); the blocks have noise `white`.
    """
    weight = kept / white**2
    weighted = weight * wings
    a, b, c = weight.sum(-1), weighted.sum(-1), (weighted * wings).sum(-1)
    d, e = (weight * means).sum(-1), (weighted * means).sum(-1)
    a = np.maximum(a, 1e-300)
    determinant = a * c - b * b
    solvable = determinant > 1e-6 * a * c
    wing = np.where(solvable, (a * e - b * d) / np.where(solvable, determinant, 1.0), 0.0)
    up = wing > 0
    wing = np.where(up, wing, 0.0)
    variance = np.where(up & solvable, c / np.where(solvable, determinant, 1.0), 1 / a)
    return (d - wing * b) / a, wing, variance


def _middle(values, kept):
    """Median (C,) of the kept values (C, B); 0 of none."""
    order = np.sort(np.where(kept, values, np.inf), axis=1)
    middle = np.take_along_axis(order, kept.sum(axis=1)[:, None] // 2, 1)[:, 0]
    return np.where(np.isfinite(middle), middle, 0.0)


def _spread(values, white, middle, kept):
    """Scatter (C, B) of blocks about the middle (C,).

    It is their white noise times the ratio of the kept blocks' scatter to it, at least 1.
    """
    wide = SIGMAS_A_MAD * _middle(np.abs(values - middle[:, None]) / white, kept)
    return np.maximum(1.0, wide)[:, None] * white
