"""Planes made of other planes: flags of several masks, contexts, weights with a factor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mosaic import Plane


@dataclass(frozen=True, eq=False)
class AnyFlagPlane:
    """True where any of several masks has any of its bits; of a mask with None, any bit at all.

    masks: pairs of a Plane and the sum of the bits
    """

    masks: tuple[tuple[Plane, int | None], ...]

    def read(self, box) -> np.ndarray:
        """The flags (Ny, Nx) bool of a Box."""
        found = np.zeros(box.shape, bool)
        for plane, value in self.masks:
            flags = plane.read(box)
            found |= flags != 0 if value is None else (flags.astype(np.int64) & value) != 0
        return found


@dataclass(frozen=True, eq=False)
class NoContextPlane:
    """True where the contexts of a drizzled mosaic name no image that went into a pixel.

    contexts: planes of 32 images each, a bit for each
    """

    contexts: tuple[Plane, ...]

    def read(self, box) -> np.ndarray:
        """The flags (Ny, Nx) bool of a Box."""
        return ~np.any([plane.read(box) != 0 for plane in self.contexts], axis=0)


@dataclass(frozen=True, eq=False)
class ScaledPlane:
    """A plane times a factor."""

    plane: Plane
    factor: float

    def read(self, box) -> np.ndarray:
        """The pixels of a Box, float64."""
        return np.asarray(self.plane.read(box), np.float64) * self.factor
