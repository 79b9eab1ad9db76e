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
# Numbers of cells along an axis, spread over an image, by which the level of its sky is measured,
# and the quantile of theirs that is the level: the darkest have the fewest sources. Images of fewer
# cells than MIN_CELLS may be full of one galaxy.
CELLS_AN_AXIS, MIN_CELLS, DARKEST = 16, 16, 0.1
# [1] of a pixel's noise: smaller levels are left, as faint sources alone have 0.06 in `simulate
# field --sky real` without faults.
MIN_LEVEL = 0.1


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


def find_background(read, good, shape) -> Background:
    """The Background of an image.

    read: called with a Box, returns its pixels; good: called with a Box, returns its valid pixels
    shape (Ny, Nx) [px]

    The level of a cell is that of `sky.noise.background`, with sources clipped. Cells with fewer
    than 32 valid pixels get the level of their neighbours. Then each level is replaced by the
    median of 3 x 3 cells, which removes cells dominated by a bright galaxy.
    """
    edges = _edges(shape)
    counts = [len(part) - 1 for part in edges]
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


def find_sky(read, good, shape) -> tuple[Background | None, float]:
    """The level of an image's sky as a Background, and in units of a pixel's noise.

    None of a level within MIN_LEVEL, and of an image of fewer than MIN_CELLS valid cells.

    read, good, shape: see `find_background`
    """
    edges, found = _edges(shape), []
    rows, columns = (_spread(len(part) - 1) for part in edges)
    for i in rows:
        for j in columns:
            (y, x), (y1, x1) = ((int(edges[0][i + k]), int(edges[1][j + k])) for k in (0, 1))
            cell = Box(y, x, y1, x1)
            try:
                pixels = read(cell)[good(cell)]
            except (OSError, ValueError):  # the search of its tile gives the reason
                continue
            if np.isfinite(pixels).sum() >= MIN_PIXELS:
                found.append(background(pixels))
    if len(found) < MIN_CELLS:
        return None, 0.0
    levels, noise = np.array(found).T
    level, sigma = float(np.quantile(levels, DARKEST)), float(np.median(noise))
    if not abs(level) > MIN_LEVEL * sigma > 0:
        return None, 0.0
    return Background(np.full((1, 1), level), (float(shape[0]), float(shape[1]))), level / sigma


def _edges(shape):
    """Edges of cells along each axis of an image (Ny, Nx) [px]."""
    counts = [max(1, round(n / CELL_PX)) for n in shape]
    return [np.linspace(0, n, k + 1).astype(int) for n, k in zip(shape, counts, strict=True)]


def _spread(n):
    """At most CELLS_AN_AXIS of n cells, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, CELLS_AN_AXIS)).astype(int)).tolist()
