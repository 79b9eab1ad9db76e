"""The sky of a mosaic: a smooth surface through the medians of cells, for images that have one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..sky.box import Box
from ..sky.noise import MIN_PIXELS, background

# [px] Side of a cell. Large against sources, which else are taken for sky: with smaller cells the
# wings of bright galaxies go; with larger ones gradients of the sky stay.
CELL_PX = 128


@dataclass(frozen=True, eq=False)
class Background:
    """A surface through levels at the middles of cells, linear between them.

    Beyond the outer ones it goes on as between the last two.

    levels (n_y, n_x) [counts]; cell (2,) [px]: their distance (y, x)
    """

    levels: np.ndarray
    cell: tuple[float, float]

    def read(self, box) -> np.ndarray:
        """The surface [counts] on a Box."""
        axes = [
            (np.arange(a, b) + 0.5) / cell + 0.5  # of the levels with one more on each side
            for a, b, cell in zip(box[:2], box[2:], self.cell, strict=True)
        ]
        where = np.meshgrid(*axes, indexing="ij")
        levels = np.pad(self.levels, 1, mode="reflect", reflect_type="odd")
        return ndimage.map_coordinates(levels, where, order=1, mode="nearest")


def find_background(read, good, shape) -> Background:
    """The Background of an image.

    read: called with a Box, returns its pixels; good: the same, which of them count
    shape (Ny, Nx) [px]

    Each cell has the level of `sky.noise.background`, sources clipped away; cells without 32 good
    pixels that of their neighbours; then each takes the median of the 3 x 3 about it, so that a
    cell full of a bright galaxy does not count.
    """
    counts = [max(1, round(n / CELL_PX)) for n in shape]
    edges = [np.linspace(0, n, k + 1).astype(int) for n, k in zip(shape, counts, strict=True)]
    levels = np.full(counts, np.nan)
    for i in range(counts[0]):
        strip = Box(int(edges[0][i]), 0, int(edges[0][i + 1]), shape[1])
        pixels, usable = read(strip), good(strip)
        for j in range(counts[1]):
            columns = slice(edges[1][j], edges[1][j + 1])
            cell = pixels[:, columns][usable[:, columns]]
            if np.isfinite(cell).sum() >= MIN_PIXELS:
                levels[i, j] = background(cell)[0]
    if np.isnan(levels).all():
        raise ValueError("background: no cell of the image has 32 good pixels")
    empty = np.isnan(levels)
    _, nearest = ndimage.distance_transform_edt(empty, return_indices=True)
    levels = ndimage.median_filter(levels[tuple(nearest)], 3, mode="nearest")
    return Background(levels, tuple(n / k for n, k in zip(shape, counts, strict=True)))
