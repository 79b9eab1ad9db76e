"""Level of the sky in the source-free pixels of an observation, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

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
# Powers of the distance by which wings may fall. The outskirts of ellipticals (n = 4) fall as
# r^-2.5 to r^-3.5 from 3 to 12 effective radii, exponential disks faster, and stars as their PSF,
# often a Moffat profile of r^-5 to r^-9.5. Without the last power a level of -0.5 to -0.8 sigma was
# found in 8 of 8 images of 40 and 60 stars without any sky.
POWERS = 2.0, 3.0, 4.0, 8.0


@dataclass(frozen=True)
class BlockGrid:
    """B square blocks of pixels of an image, in rows.

    corner (2,) [px]: first pixel of the first one; counts (2,): numbers along y, x; side [px]
    """

    corner: tuple[int, int]
    counts: tuple[int, int]
    side: int

    @classmethod
    @lru_cache(maxsize=32)
    def of(cls, shape) -> BlockGrid:
        """That of images of a shape (2,), none of images smaller than a block."""
        side = max(MIN_BLOCK_PX, -(-max(shape) // N_BLOCKS))
        n_y, n_x = (n // side if min(shape) >= side else 0 for n in shape)
        y, x = (n % side // 2 for n in shape)
        return cls((y, x), (n_y, n_x), side)

    @cached_property
    def centers(self) -> np.ndarray:
        """Their centres (B, 2) [px]."""
        pairs = zip(self.corner, self.counts, strict=True)
        axes = [first + self.side * np.arange(n) + (self.side - 1) / 2 for first, n in pairs]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)

    def sums(self, values) -> np.ndarray:
        """Sums (C, B) over them of values (C, My, Mx)."""
        (n_y, n_x), side = self.counts, self.side
        cut = values[self._inner].reshape(len(values), n_y, side, n_x, side)
        return np.einsum("cyixj->cyx", cut).reshape(len(values), -1)

    def on_pixels(self, values, shape) -> np.ndarray:
        """Their values (C, B) on the pixels (C, My, Mx) of an image, 0 beyond them."""
        out = np.zeros(shape, values.dtype)
        rows = values.reshape(len(values), *self.counts).repeat(self.side, axis=1)
        out[self._inner] = rows.repeat(self.side, axis=2)
        return out

    @property
    def _inner(self):
        pairs = zip(self.corner, self.counts, strict=True)
        return (slice(None), *(slice(a, a + n * self.side) for a, n in pairs))


@dataclass(frozen=True, eq=False)
class SkyLevel:
    """Level of the sky in each channel of an observation.

    level (C,) [counts]: of source-free pixels, after subtraction of the sources' wings
    error (C,) [counts]: total error of the level; infinite if too few pixels are free of sources
    wings (C,) [counts]: contribution of the unknown slope of wings to the error, which has the same
        sign in all channels
    rim (C,) [counts]: level of the pixels furthest from the sources, wings included
    rim_error (C,) [counts]: error of the rim; infinite if it is unknown
    blocks: BlockGrid; dark (C, B): bool, those by which the level is measured
    block_scatter (C,): scatter of their means about the model, over that of white noise, at
        least 1
    """

    level: np.ndarray
    error: np.ndarray
    wings: np.ndarray
    rim: np.ndarray
    rim_error: np.ndarray
    blocks: BlockGrid
    dark: np.ndarray
    block_scatter: np.ndarray

    def expected(self, wrong, dark, width) -> SkyLevel:
        """The SkyLevel that a fit expects: as measured in channels `wrong` (C,), that are not at 0.

        In channels `dark` (C,), whose rim shows that, it is the rim's if the level is above it.
        Others are measured too, and expected within `width` (C,) [counts] of 0: a larger error
        would leave the light of wide sources to the sky.
        """
        by_rim = dark & (self.rim < self.level)
        level = np.where(by_rim, self.rim, self.level)
        error = np.where(by_rim, np.minimum(self.rim_error, width), self.error)
        shown = wrong | dark
        part = np.where(shown, 1, 1 / (1 + (error / width) ** 2))
        error = np.where(shown, error, width * np.sqrt(np.maximum(1 - part, 0)))
        return replace(self, level=part * level, error=error)


def sky_level(image) -> SkyLevel:
    """The SkyLevel of an InspectedImage.

        mean of block b = level + wing T_b,    T_b = sum_s f_s (r_sb^2 + r_0^2)^(-p/2),    wing >= 0

    fitted with each of POWERS to the means of blocks of pixels in the darker half of the image,
    without 3-sigma outliers. f_s is the light at source s, r its distance, r_0 the PSF's FWHM. The
    level is the mean of all powers, weighted by how well they fit. Part of its error is their
    scatter about it, at least half of the change between the powers beside the best one; the rest
    follows from the scatter of the blocks, which includes correlated noise.
    """
    data, usable = image.observation.data, image.usable
    n_channels, blocks = len(data), BlockGrid.of(data.shape[1:])
    counts, centers = blocks.sums(usable.astype(np.float64)), blocks.centers
    means = blocks.sums(np.where(usable, data, 0.0)) / np.maximum(counts, 1)
    white = image.sigma[:, None] / np.sqrt(np.maximum(counts, 1))
    wings = _wings(image, means, centers)
    darker = _darker(image, centers, wings[0])
    known = 2 * counts > blocks.side**2
    dark = known & (darker < DARK)
    if not (dark.sum(axis=1) >= MIN_BLOCKS).any():
        zeros, endless = np.zeros(n_channels), np.full(n_channels, np.inf)
        return SkyLevel(zeros, endless, zeros, zeros, endless, blocks, dark, zeros + 1)
    kept, none, each = dark, np.zeros(n_channels), np.arange(n_channels)
    for _ in range(N_ROUNDS):
        levels, wing, variances = _fitted(means, wings, white, kept)
        off = means - levels[..., None] - wing[..., None] * wings
        chi2 = (kept * np.square(off / white)).sum(axis=-1)
        best = chi2.argmin(axis=0), each
        spread = _spread(off[best], white, none, kept)
        before, kept = kept, dark & (np.abs(off[best]) < CLIP * spread)
        if (kept == before).all():
            break
    scale = (spread / white).max(axis=1)
    weight = np.exp((chi2[best] - chi2) / (2 * scale**2))
    weight /= weight.sum(axis=0)
    level, variance = (weight * levels).sum(axis=0), (weight * variances).sum(axis=0)
    beside = np.clip(best[0] + np.array([[-1], [1]]), 0, len(POWERS) - 1)
    unsure = np.maximum(
        np.sqrt((weight * (levels - level) ** 2).sum(axis=0)),
        np.abs(np.diff(levels[beside, each], axis=0)[0]) / 2,
    )
    enough = kept.sum(axis=1) >= MIN_BLOCKS
    rim, rim_error = _rim(means, white, known & (darker < RIM))
    return SkyLevel(
        np.where(enough, level, 0.0),
        np.where(enough, np.sqrt(variance * scale**2 + unsure**2), np.inf),
        np.where(enough, unsure, 0.0),
        rim,
        rim_error,
        blocks,
        kept,
        scale,
    )


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


def _darker(image, centers, wings):
    """Rank (B,) of the blocks by the light of wings (C, B) in them, from 0, the darkest, to 1.

    Infinite of those in a source.
    """
    light = (wings / image.sigma[:, None]).sum(axis=0) if len(wings) else np.zeros(len(centers))
    free = away_from_sources(image, centers, NEAR_SOURCE)
    rank = np.full(len(centers), np.inf)
    order = np.argsort(light[free], kind="stable")
    rank[np.flatnonzero(free)[order]] = np.arange(len(order)) / max(len(order), 1)
    return rank


def away_from_sources(image, centers, least):
    """Selects centres (B,) of blocks further than `least` [FWHM] from all sources of an image."""
    places = image.places[np.isfinite(image.places).all(axis=1)]
    squares = ((centers[:, None] - places) ** 2).sum(axis=-1)
    return (squares > (least * image.width_px) ** 2).all(axis=1)


def _wings(image, means, centers):
    """Light of wings (P, C, B) [counts] about the sources that fall by each of POWERS.

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
