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

    The level of a cell is that of `sky.noise.background`, with sources clipped. Cells with fewer
    than 32 valid pixels, and those filled with one value, get the level of their neighbours. Then
    each level is replaced by the median of 3 x 3 cells, which removes cells dominated by a bright
    galaxy.
    """
    edges = cell_edges(shape, CELL_PX)
    counts = [len(part) - 1 for part in edges]
    levels, scatters = np.full(counts, np.nan), np.zeros(counts)
    for i in range(counts[0]):
        strip = Box(int(edges[0][i]), 0, int(edges[0][i + 1]), shape[1])
        pixels, usable = read(strip), good(strip)
        for j in range(counts[1]):
            columns = slice(edges[1][j], edges[1][j + 1])
            cell = pixels[:, columns][usable[:, columns]]
            if np.isfinite(cell).sum() >= MIN_PIXELS:
                levels[i, j], scatters[i, j] = background(cell)
    if np.isnan(levels).all():
        raise ValueError("background: no cell of the image has 32 good pixels")
    empty = np.isnan(levels)
    if scatters.any():
        empty |= scatters == 0
    _, nearest = ndimage.distance_transform_edt(empty, return_indices=True)
    levels = ndimage.median_filter(levels[tuple(nearest)], 3, mode="nearest")
    return Background(levels, tuple(n / k for n, k in zip(shape, counts, strict=True)))


def cell_edges(shape, side):
    """Edges of cells of about `side` [px] along each axis of an image (Ny, Nx) [px]."""
    counts = [max(1, round(n / side)) for n in shape]
    return [np.linspace(0, n, k + 1).astype(int) for n, k in zip(shape, counts, strict=True)]
