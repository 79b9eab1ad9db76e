"""Rectangles of pixels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


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

    def meet(self, other) -> Box:
        """What both hold; of area 0 where they do not meet."""
        y0, x0 = max(self.y0, other.y0), max(self.x0, other.x0)
        return Box(y0, x0, max(min(self.y1, other.y1), y0), max(min(self.x1, other.x1), x0))

    def join(self, other) -> Box:
        """The smallest box with both."""
        low = min(self.y0, other.y0), min(self.x0, other.x0)
        return Box(*low, max(self.y1, other.y1), max(self.x1, other.x1))

    def within(self, other) -> Box:
        """The same pixels counted from the first pixel of `other`."""
        y, x = other.y0, other.x0
        return Box(self.y0 - y, self.x0 - x, self.y1 - y, self.x1 - x)

    def holds(self, positions) -> np.ndarray:
        """Which positions (..., 2) [px], (y, x), lie on its pixels; an edge belongs to one side."""
        positions = np.asarray(positions)
        low, high = np.array(self[:2]) - 0.5, np.array(self[2:]) - 0.5
        return ((positions >= low) & (positions < high)).all(axis=-1)

    @classmethod
    def of(cls, shape) -> Box:
        """All pixels of an image (Ny, Nx)."""
        return cls(0, 0, int(shape[0]), int(shape[1]))

    @classmethod
    def around(cls, points) -> Box:
        """The pixels that points (..., 2) [px], (y, x), touch. ValueError: one is not finite."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not np.isfinite(points).all():
            raise ValueError("points has some that are not finite")
        low, high = np.floor(points.min(0) + 0.5), np.floor(points.max(0) + 0.5)
        return cls(int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)


def sized_up(box, step) -> Box:
    """The box, larger about its middle, with sides that are multiples of `step` [px]."""
    sides = [step * math.ceil(n / step) for n in box.shape]
    y0, x0 = (a - (side - n) // 2 for a, n, side in zip(box[:2], box.shape, sides, strict=True))
    return Box(y0, x0, y0 + sides[0], x0 + sides[1])
