"""The sky background of a mosaic: a smooth surface through the medians of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..sky.box import Box
from ..sky.noise import MIN_PIXELS, background

# [px] Side of a cell, large compared to sources. With smaller cells the wings of bright galaxies
# are subtracted as sky; with larger ones gradients of the sky remain.
CELL_PX = 128
# [px] Side of blocks of pixels, and [sigma] of their means above which they are light of sources.
BLOCK_PX, LIT = 4, 3.0
# [blocks] Scales of the Gaussians whose mean is the shape of wings: it falls about as r^-2.
WINGS = 1, 2, 4, 8
# Part of the blocks by which a level is measured: those with the least expected wings.
DARKER = 0.5
# [sigma of a pixel] Blocks with fewer expected wings are all used.
DARK = 0.01
# [1] Coefficient of wings, with its prior's sigma. In simulated galaxies (exponential to n = 4, S/N
# 10 to 5000, one in 46^2 px or fewer) that of all unlit blocks is 0.28 to 0.46; of those far from
# the light of small galaxies 0.0.
WING, WING_SIGMA = 0.2, 0.1
N_ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Background:
    """A surface through levels at the middles of cells, linear between them.

    Beyond the outermost levels it is extrapolated linearly.

    levels (n_y, n_x) [counts]; cell (2,) [px]: their distance (y, x)
    """

    levels: np.ndarray
    cell: tuple[float, float]

    def read(self, box) -> np.ndarray:
        """The surface [counts] on a Box."""
        axes = [
            (np.arange(a, b) + 0.5) / cell + 0.5  # index into the levels, padded by one
            for a, b, cell in zip(box[:2], box[2:], self.cell, strict=True)
        ]
        where = np.meshgrid(*axes, indexing="ij")
        levels = np.pad(self.levels, 1, mode="reflect", reflect_type="odd")
        return ndimage.map_coordinates(levels, where, order=1, mode="nearest")


@dataclass(frozen=True)
class ConstantBackground:
    """A level [counts] that is the same everywhere."""

    level: float

    def read(self, box) -> np.ndarray:
        """The level [counts] on a Box."""
        return np.full(box.shape, self.level)


def find_background(read, good, shape) -> Background:
    """The Background of an image.

    read: called with a Box, returns its pixels; good: called with a Box, returns its valid pixels
    shape (Ny, Nx) [px]

    The level of a cell is its `clean_level`. Cells with fewer than 32 valid pixels, and those
    filled with one value, get the level of their neighbours. Then each level is replaced by the
    median of 3 x 3 cells, which removes cells dominated by a bright galaxy.
    """
    edges = cell_edges(shape, CELL_PX)
    counts = [len(part) - 1 for part in edges]
    levels, spread = np.full(counts, np.nan), np.zeros(counts)
    for i in range(counts[0]):
        strip = Box(int(edges[0][i]), 0, int(edges[0][i + 1]), shape[1])
        pixels, usable = read(strip), good(strip)
        for j in range(counts[1]):
            columns = slice(edges[1][j], edges[1][j + 1])
            cell, valid = pixels[:, columns], usable[:, columns] & np.isfinite(pixels[:, columns])
            if valid.sum() >= MIN_PIXELS:
                levels[i, j], spread[i, j] = clean_level(cell, valid), np.ptp(cell[valid])
    if np.isnan(levels).all():
        raise ValueError("background: no cell of the image has 32 good pixels")
    empty = np.isnan(levels)
    if spread.any():
        empty |= spread == 0
    _, nearest = ndimage.distance_transform_edt(empty, return_indices=True)
    levels = ndimage.median_filter(levels[tuple(nearest)], 3, mode="nearest")
    return Background(levels, tuple(n / k for n, k in zip(shape, counts, strict=True)))


def clean_level(pixels, usable) -> float:
    """Level of the sky in the middle of a cell, without the light of sources and their wings.

        sky = level + slope . (y, x) + a T,   T = mean over k of G_k * light

    Blocks 3 sigma above the sky are light; around them, wings a T are expected. The sky is fitted
    to the means of that half of the others with the least T, with a prior of a, which is not below
    0. Then the clipped median of their pixels, minus slope and wings, is added to the level.

    pixels (Ny, Nx); usable (Ny, Nx): their valid ones
    Returns the level of `sky.noise.background` where too few blocks are without light.
    Errors by simulation in units of a pixel's noise, with one galaxy in 46^2 px of S/N 50 to 500 or
    of 10 to 5000: up to 0.013; those of the clipped median are 0.10 to 0.12.
    """
    valid = usable & np.isfinite(pixels)
    level, sigma = background(pixels[valid])
    if not sigma > 0:
        return level
    values = np.where(valid, (pixels - level) / sigma, 0.0)
    counts = _block_sums(valid)
    means = _block_sums(values) / np.maximum(counts, 1)
    y, x = (np.linspace(-1, 1, n) for n in counts.shape)
    plane = np.stack([np.ones_like(means), *np.meshgrid(y, x, indexing="ij")], axis=-1)
    measured = 2 * counts >= BLOCK_PX**2
    dark, sky = measured, np.zeros_like(means)
    for _ in range(N_ROUNDS):
        if dark.sum() < MIN_PIXELS:
            return level
        above = means - sky
        middle, scatter = background(above[dark])
        lit = measured & (above > middle + LIT * scatter)
        light = np.where(lit, above * counts, 0) / BLOCK_PX**2
        wings = np.mean(
            [ndimage.gaussian_filter(light, k, mode="constant", truncate=3) for k in WINGS], axis=0
        )
        dark = measured & (wings <= max(DARK, np.quantile(wings[measured], DARKER)))
        dark &= np.abs(above - middle) <= LIT * scatter
        if dark.sum() < MIN_PIXELS:
            return level
        coefficients, wing = _fit_sky(plane[dark], wings[dark], means[dark], scatter)
        sky = plane @ coefficients
    kept = _on_pixels(dark, valid.shape) & valid
    rest = values - _on_pixels(sky + wing * wings, valid.shape)
    return level + sigma * float(coefficients[0] + background(rest[kept])[0])


def _fit_sky(plane, wings, means, scatter):
    """Coefficients (3,) of a plane (B, 3) and that of wings (B,), fitted to the means of blocks."""
    weight = scatter / WING_SIGMA
    matrix = np.vstack([np.column_stack([plane, wings]), [0, 0, 0, weight]])
    *coefficients, wing = np.linalg.lstsq(matrix, np.append(means, weight * WING), rcond=None)[0]
    if wing < 0:
        coefficients, wing = np.linalg.lstsq(plane, means, rcond=None)[0], 0.0
    return np.array(coefficients), wing


def _on_pixels(blocks, shape):
    """Values of blocks on the pixels of a cell of a shape (Ny, Nx)."""
    return blocks.repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)[: shape[0], : shape[1]]


def _block_sums(values):
    """Sums of values (Ny, Nx) over blocks, those at the far edges with fewer pixels."""
    edges = [np.arange(0, n, BLOCK_PX) for n in values.shape]
    return np.add.reduceat(np.add.reduceat(values, edges[0], 0, float), edges[1], 1, float)


def cell_edges(shape, side):
    """Edges of cells of about `side` [px] along each axis of an image (Ny, Nx) [px]."""
    counts = [max(1, round(n / side)) for n in shape]
    return [np.linspace(0, n, k + 1).astype(int) for n, k in zip(shape, counts, strict=True)]
