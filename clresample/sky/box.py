"""Rectangles of pixels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .mapping import NOISE_PX

# [px] Difference in size of equal pieces of sky across an image, because of its distortion.
SAME_PX = 0.01


class Box(NamedTuple):
    """Rows y0 to y1 and columns x0 to x1 of an image, the ends not included."""

    y0: int
    x0: int
    y1: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """(Ny, Nx) [px]; zero or less where it is empty."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def area(self) -> int:
        """Number of pixels."""
        n_y, n_x = self.shape
        return max(n_y, 0) * max(n_x, 0)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Of an array that starts at pixel (0, 0)."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def grown(self, n) -> Box:
        """With n more pixels on each side."""
        return Box(self.y0 - n, self.x0 - n, self.y1 + n, self.x1 + n)

    def intersection(self, other) -> Box:
        """Common part of two boxes; of area 0, at the edge of this one, if they do not overlap."""
        y0, x0 = (min(max(self[i], other[i]), self[i + 2]) for i in (0, 1))
        return Box(y0, x0, max(min(self.y1, other.y1), y0), max(min(self.x1, other.x1), x0))

    def union(self, other) -> Box:
        """The smallest box with both."""
        low = min(self.y0, other.y0), min(self.x0, other.x0)
        return Box(*low, max(self.y1, other.y1), max(self.x1, other.x1))

    def relative_to(self, other) -> Box:
        """The same pixels counted from the first pixel of `other`."""
        y, x = other.y0, other.x0
        return Box(self.y0 - y, self.x0 - x, self.y1 - y, self.x1 - x)

    def contains(self, positions) -> np.ndarray:
        """Selects positions (..., 2) [px], (y, x), on its pixels; an edge belongs to one side."""
        positions = np.asarray(positions)
        low, high = np.array(self[:2]) - 0.5, np.array(self[2:]) - 0.5
        return ((positions >= low) & (positions < high)).all(axis=-1)

    @classmethod
    def of(cls, shape) -> Box:
        """All pixels of an image (Ny, Nx)."""
        return cls(0, 0, int(shape[0]), int(shape[1]))

    @classmethod
    def at(cls, origin, shape) -> Box:
        """The pixels of an image of `shape` (2,) [px] whose first one is at `origin` (2,) [px]."""
        y, x, n_y, n_x = map(int, (*origin, *shape))  # sums of NumPy's numbers take longer
        return cls(y, x, y + n_y, x + n_x)

    @classmethod
    def around(cls, points) -> Box:
        """Box of the pixels that points (..., 2) [px], (y, x), touch.

        Raises ValueError for points that are not finite.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not np.isfinite(points).all():
            raise ValueError("points has some that are not finite")
        low, high = np.floor(points.min(0) + 0.5), np.floor(points.max(0) + 0.5)
        return cls(int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)


def outline(shape):
    """Rows and columns [px] of points along the outer edge of an image, every 16 px at most."""
    n_y, n_x = shape
    rows = np.linspace(-0.5, n_y - 0.5, max(2, n_y // 16 + 2))
    columns = np.linspace(-0.5, n_x - 0.5, max(2, n_x // 16 + 2))
    y = [rows, rows, np.full_like(columns, -0.5), np.full_like(columns, n_y - 0.5)]
    x = [np.full_like(rows, -0.5), np.full_like(rows, n_x - 0.5), columns, columns]
    return np.concatenate(y), np.concatenate(x)


def box_within(points, margin, step, whole) -> Box:
    """The pixels whose centres lie between points (n, 2) [px], (y, x), of the Box `whole`.

    With `margin` more on each side, and more until the sides are multiples of `step`. At an edge of
    `whole` the additional pixels are taken on the other side, so that the shape does not depend on
    the position of the points in `whole`.
    """
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    sides = []
    for a, b, start, end in zip(low, high, whole[:2], whole[2:], strict=True):
        first, last = math.ceil(a - NOISE_PX), math.floor(b + NOISE_PX)
        if max(first, start) > min(last, end - 1):
            return Box(whole.y0, whole.x0, whole.y0, whole.x0)
        n = max(last - first + 1, math.ceil(b - a - SAME_PX))
        n = min(step * math.ceil(n / step), end - start)
        first = min(max(first - (n - (last - first + 1)) // 2, start), end - n)
        sides.append((first, first + n))
    (y0, y1), (x0, x1) = sides
    return Box(y0, x0, y1, x1)


def round_up_size(box, step) -> Box:
    """The box, larger about its middle, with sides that are multiples of `step` [px]."""
    sides = [step * math.ceil(n / step) for n in box.shape]
    y0, x0 = (a - (side - n) // 2 for a, n, side in zip(box[:2], box.shape, sides, strict=True))
    return Box(y0, x0, y0 + sides[0], x0 + sides[1])


def intersect_boxes(origin_a, shape_a, origin_b, shape_b):
    """Common part of two boxes of pixels: slices of the first array and of the second.

    origin_a, origin_b (2,) [px]: first pixels (y, x), on one grid; shape_a, shape_b (2,) [px]
    Slices are empty where the boxes do not meet.
    """
    a, b = Box.at(origin_a, shape_a), Box.at(origin_b, shape_b)
    both = a.intersection(b)
    return both.relative_to(a).slices, both.relative_to(b).slices


def boxes_meet(low, high, other_low, other_high):
    """Selects pairs of boxes (..., 2) [px] that share a pixel; arguments are broadcast.

    low, high: first pixels (y, x), and the ones past the last
    """
    return ((low < other_high) & (other_low < high)).all(axis=-1)


def box_slices(origin, shape):
    """The slices (y, x) of a box of `shape` (2,) [px] that starts at `origin` (2,) [px]."""
    return Box.at(origin, shape).slices
