"""Unions, intersections and overlaps of grids."""

from __future__ import annotations

import numpy as np

from .mapping import BLOCK, NOISE_PX, lattice

# Pixels per axis that `grids_overlap` tests first. They find overlaps of 1/33 of a side of the part
# within reach. More pixels cost time in every call; with fewer, all pixels are tested more often.
N_PROBES = 33


def grid_union(grids, *, like):
    """Smallest grid on `like`'s pixels that contains or touches every pixel of `grids`."""
    boxes = np.array([_box(grid, like) for grid in grids])
    return _on(like, boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0))


def grid_intersection(grids, *, like):
    """Grid on `like`'s pixels where the bounding boxes of all `grids` meet.

    Raises ValueError where they do not.
    """
    boxes = np.array([_box(grid, like) for grid in grids])
    low, high = boxes[:, 0].max(axis=0), boxes[:, 1].min(axis=0)
    if (high < low).any():
        raise ValueError(f"grids do not overlap: rows, columns {low} to {high} of `like` are empty")
    return _on(like, low, high)


def _on(like, low, high):
    """Grid of `like`'s pixels from the first to the last one (y, x)."""
    return like.cutout(int(low[0]), int(low[1]), tuple(int(n) for n in high - low + 1))


def _box(grid, like):
    """First and last pixel (y, x) of `like` that a grid's outer edges touch: (2, 2)."""
    grid.check_like(like, "like")
    edges = grid.positions_in(like, *lattice((0, 0), grid.shape))
    if not np.isfinite(edges).all():
        raise ValueError("grids: one extends to where `like`'s projection has no sky")
    low = np.floor(edges.min(axis=(0, 1)) + 0.5 + NOISE_PX)
    return low, np.maximum(np.ceil(edges.max(axis=(0, 1)) + 0.5 - NOISE_PX) - 1, low)


def grids_overlap(grid_out, grid_in) -> bool:
    """Returns True if the centre of any pixel of `grid_out` lies on `grid_in`, a grid of its kind.

    First some pixels are tested, spread over the part of `grid_out` that `grid_in` can reach; all
    pixels of that part are tested only if none of these lies on it.
    """
    last = np.array(grid_out.shape) - 1
    try:
        low, high = _box(grid_in, grid_out)
    except ValueError:  # grid_out's projection does not cover all of grid_in: no bounds
        low, high = np.zeros(2), last
    # one pixel more for the curvature of an outline between the points of the lattice
    low, high = np.maximum(low - 1, 0).astype(int), np.minimum(high + 1, last).astype(int)
    if (high < low).any():
        return False
    rows, columns = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    probes = (axis[:: -(-len(axis) // N_PROBES)] for axis in (rows, columns))
    if _any_on(grid_out, grid_in, *probes):
        return True
    n_rows = max(1, BLOCK // len(columns))
    return any(
        _any_on(grid_out, grid_in, rows[i : i + n_rows], columns)
        for i in range(0, len(rows), n_rows)
    )


def _any_on(grid_out, grid_in, rows, columns):
    """Returns True if any of these pixels of grid_out has its centre on grid_in."""
    at = grid_out.positions_in(grid_in, rows[:, None], columns[None])
    top = np.array(grid_in.shape) - 0.5 + NOISE_PX
    return bool(((at >= -0.5 - NOISE_PX) & (at <= top)).all(axis=-1).any())


def bounding_boxes_overlap(one, other, like) -> bool:
    """Returns True if the bounding boxes of two grids meet on `like`'s pixels."""
    try:
        grid_intersection([one, other], like=like)
    except ValueError:  # they do not, or `like`'s projection does not cover them
        return False
    return True
