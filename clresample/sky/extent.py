"""Which part of a pixel grid other grids touch: unions, intersections, overlaps."""

from __future__ import annotations

import numpy as np

from .grid import positions
from .mapping import NOISE_PX, lattice


def union(grids, *, like):
    """Smallest grid on `like`'s pixels that holds every pixel of `grids`, whole or in part."""
    boxes = np.array([_box(grid, like) for grid in grids])
    return _on(like, boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0))


def intersection(grids, *, like):
    """Grid on `like`'s pixels where the bounding boxes of all `grids` meet.

    Raises ValueError where they do not.
    """
    boxes = np.array([_box(grid, like) for grid in grids])
    low, high = boxes[:, 0].max(axis=0), boxes[:, 1].min(axis=0)
    if (high < low).any():
        raise ValueError(f"grids do not overlap: rows, columns {low} to {high} of `like` are empty")
    return _on(like, low, high)


def _on(like, low, high):
    return like.cutout(int(low[0]), int(low[1]), tuple(int(n) for n in high - low + 1))


def _box(grid, like):
    """First and last pixel (y, x) of `like` that a grid's outer edges touch: (2, 2)."""
    grid._check_like(like, "like")
    n, m = lattice((0, 0), grid.shape)
    edges = positions(grid, like, n, m)
    if not np.isfinite(edges).all():
        raise ValueError("grids: one reaches where `like`'s projection holds no sky")
    low = np.floor(edges.min(axis=(0, 1)) + 0.5 + NOISE_PX)
    return low, np.maximum(np.ceil(edges.max(axis=(0, 1)) + 0.5 - NOISE_PX) - 1, low)


def overlap(grid_out, grid_in):
    """Whether the centre of any pixel of grid_out lies on grid_in."""
    try:
        return bool(grid_out.map_to(grid_in).covered.any())
    except ValueError:  # the projection of one holds nothing of the other
        return False


def boxes_meet(one, other, like):
    try:
        intersection([one, other], like=like)
    except ValueError:  # they do not, or `like`'s projection does not hold them
        return False
    return True
