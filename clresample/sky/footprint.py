"""Pixels of an observation in the model frame, and the part of the frame that they cover."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from .mapping import Mapping
from .observation import Observation

# Iterations of p <- p + A^-1 (X - X(p)) for a distorted mapping: each multiplies the error by the
# relative change of the Jacobian, at most 1e-2 in real instruments. Three leave 1e-6 of it; more
# would only cost time.
INVERSE_ROUNDS = 3
# neighbours of a pixel: those that share a side or a corner with it
NEIGHBOURS = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True, eq=False)
class Footprint:
    """One observation's pixels in the model frame: X(p) = A p + t + shift.

    observation: the Observation; mapping: from its grid to the frame's; shift (2,) [model px]
    """

    observation: Observation
    mapping: Mapping
    shift: np.ndarray

    @cached_property
    def used(self) -> np.ndarray:
        """Pixels (C, My, Mx) that a fit uses: on the frame, with a weight after whitening."""
        return (self.observation.whitened.weights > 0) & self.mapping.covered

    @property
    def pixel_scale(self) -> float:
        """Side of a pixel of the observation [model px]."""
        return float(np.sqrt(abs(np.linalg.det(self.mapping.matrix))))

    @cached_property
    def positions(self) -> np.ndarray:
        """Centres (My, Mx, 2) [model px] of all pixels: (y, x)."""
        n, m = np.indices(self.mapping.shape_out)
        return self.mapping.at(n, m) + self.shift

    def locate(self, points) -> np.ndarray:
        """Points (..., 2) [model px] in observed pixels (n, m): the inverse of X(p)."""
        points = np.asarray(points, dtype=np.float64) - self.shift
        inverse = np.linalg.inv(self.mapping.matrix)
        pixels = (points - self.mapping.offset) @ inverse.T
        if self.mapping.geometry == "distorted":
            top = np.array(self.mapping.shape_out) - 1
            for _ in range(INVERSE_ROUNDS):
                near = np.clip(np.rint(np.nan_to_num(pixels)), 0, top).astype(int)
                pixels = near + (points - self.mapping.at(near[..., 0], near[..., 1])) @ inverse.T
        return pixels

    def contains(self, points) -> np.ndarray:
        """Selects points (..., 2) [model px] on an image's pixel, weighted or not: (...)."""
        return self.nearest_pixels(points)[0]

    def weighted(self, points) -> np.ndarray:
        """True where the pixel at points (..., 2) [model px] has a weight: (C, ...) bool."""
        held, (n, m) = self.nearest_pixels(points)
        return held & (self.observation.weights > 0)[:, n, m]

    def nearest_pixels(self, points):
        """Tests if points (..., 2) [model px] lie on the image; returns their nearest pixels too.

        (...) bool, and (2, ...) int.
        """
        pixels = np.floor(np.nan_to_num(self.locate(points), nan=-1.0) + 0.5)
        top = np.array(self.mapping.shape_out) - 1
        (y, x), (last_y, last_x) = np.moveaxis(pixels, -1, 0), top
        held = (y >= 0) & (y <= last_y) & (x >= 0) & (x <= last_x)
        return held, np.stack([np.clip(y, 0, last_y), np.clip(x, 0, last_x)]).astype(int)


def coverage_border(outside) -> np.ndarray:
    """Pixels (Ny, Nx) bool of the frame from which light may leave the observed area.

    Those on the frame's edge, those outside, and the neighbours of these; outside: `unobserved`.
    """
    return ndimage.binary_dilation(outside, NEIGHBOURS)[1:-1, 1:-1]


def unobserved(footprints, shape) -> np.ndarray:
    """Unobserved pixels of the frame, with a border: (Ny + 2, Nx + 2) bool.

    These are the border and all pixels without weight in any channel that are connected to it
    through such pixels. Masked pixels inside an image, single or in groups, do not belong to them,
    nor do strips no wider than the FWHM of the sharpest PSF, such as bad rows and columns: light
    on them is known from the pixels on both sides.
    """
    points = np.stack([*np.indices(shape)], axis=-1)
    seen, widths = np.zeros(shape, dtype=bool), []
    for footprint in footprints:
        held, (n, m) = footprint.nearest_pixels(points)
        seen |= held & (footprint.observation.weights > 0).any(axis=0)[n, m]
        widths.append(footprint.pixel_scale * footprint.observation.psf.fwhm_px.min())
    ring = np.pad(np.zeros(shape, dtype=bool), 1, constant_values=True)
    if seen.all():
        return ring
    wider = int(min(widths)) + 1
    outside = np.pad(~seen, wider, constant_values=True).astype(np.uint8)
    inner = slice(wider - 1, 1 - wider or None)
    wide = ndimage.grey_opening(outside, size=wider)[inner, inner] > 0
    return ndimage.binary_propagation(ring, NEIGHBOURS, mask=wide)
