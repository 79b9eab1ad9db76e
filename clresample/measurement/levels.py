"""Smooth levels of signal-to-noise images: sky left in, and the far wings of bright sources.

A smooth level lifts peaks of noise over the threshold and connects all light of an image. It is
estimated as the median in cells of `CELL_PX`, over 3 x 3 cells, and interpolated between them. A
level up to `DEAD_SIGMA` is attributed to faint sources and not subtracted.

Sources have no negative light, so a level below zero is that of a sky of which too much was
subtracted, however small the image, see `deficit_of`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..sky.noise import sigma_below_zero

CELL_PX = 64  # [px] of the model: several times the size of the galaxies in deep images
MIN_CELLS = 8  # along each axis: in fewer, a bright galaxy with its neighbours may fill most
# [sigma] of a level that is left: faint sources raise the median of blank cells
DEAD_SIGMA = 1.0
# [1] of the cells: a field's darkest ones have its sky alone
DARKEST = 0.1
# [errors of a median] from which a negative median is a level. Left in, -0.1 of a pixel's noise
# hides 19 of 54 galaxies of signal to noise 9 to 20, and -0.2 all of them.
DEFICIT = 3.0
OF_MEDIAN = 1.25  # error of a median over that of a mean


def level_of(image, seen):
    """Level (Ny, Nx) [sigma] of an image and that of its sky [sigma], 0 within DEAD_SIGMA.

    image (Ny, Nx) [sigma]; seen (Ny, Nx) bool: its pixels with data. Cells with few of them have
    the level of all cells together; images of fewer than MIN_CELLS along an axis have none
    """
    if min(image.shape) < MIN_CELLS * CELL_PX:
        return np.zeros(image.shape, np.float32), 0.0
    cells = _medians(image, seen)
    if not np.isfinite(cells).any():
        return np.zeros(image.shape, np.float32), 0.0
    cells = np.where(np.isfinite(cells), cells, np.nanmedian(cells))
    sky = float(_clear(np.quantile(cells, DARKEST)))
    cells = _clear(ndimage.median_filter(cells, 3, mode="nearest"))
    if not cells.any():
        return np.zeros(image.shape, np.float32), sky
    return _between(cells, image.shape), sky


def deficit_of(image, seen, area):
    """Negative level (Ny, Nx) or float [sigma] of a signal-to-noise image; 0 where it has none.

    image (Ny, Nx) [sigma]; seen (Ny, Nx) bool: its pixels with data
    area [px]: over which its noise is correlated
    """
    values = image[seen]
    if not values.size:
        return 0.0
    middle = float(np.median(values))
    scatter = sigma_below_zero(values - middle)
    if scatter is None:  # too few pixels
        return 0.0
    error = OF_MEDIAN * np.sqrt(area) * scatter
    level = middle if middle < -DEFICIT * error / np.sqrt(values.size) else 0.0
    cells = _medians(image, seen) - level
    deep = cells < -DEFICIT * error / CELL_PX
    return level + _between(np.where(deep, cells, 0.0), image.shape) if deep.any() else level


def _medians(image, seen):
    """Medians of an image in cells of `CELL_PX`, NaN where less than a quarter is seen."""
    n_y, n_x = (max(1, round(n / CELL_PX)) for n in image.shape)
    rows, columns = (np.linspace(0, n, k + 1).astype(int) for n, k in zip(image.shape, (n_y, n_x)))
    cells = np.full((n_y, n_x), np.nan)
    for i in range(n_y):
        for j in range(n_x):
            where = np.s_[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
            values = image[where][seen[where]]
            if values.size > seen[where].size / 4:
                cells[i, j] = np.median(values)
    return cells


def _between(cells, shape):
    """Levels (Ny, Nx) float32 of an image of this shape, between the middles of its cells."""
    at = [(np.arange(n) + 0.5) * k / n - 0.5 for n, k in zip(shape, cells.shape, strict=True)]
    places = np.meshgrid(*at, indexing="ij")
    return ndimage.map_coordinates(cells, places, order=1, mode="nearest").astype(np.float32)


def _clear(level):
    """Levels, 0 where they are within DEAD_SIGMA."""
    return np.where(np.abs(level) > DEAD_SIGMA, level, 0.0)
