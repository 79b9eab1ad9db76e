"""PSFs known at places: images at scattered positions, and an array of cells."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...sky.psf import PSF
from ...sky.varying_psf.field import PSFField, check_position


@dataclass(frozen=True, eq=False)
class ScatteredPSF(PSFField):
    """PSF images at K scattered places.

    Inside a Delaunay triangle of three positions the images are interpolated linearly. Outside all
    triangles the nearest image is used, and so it is everywhere if there are fewer than three
    positions, or if all lie on a line. A mean of normalised PSFs is normalised, and its second
    moments are the mean of theirs, to first order in the change of the PSF between them.

    images (K, C, ny, nx) or (K, ny, nx) [1]: pixel response included
    positions (K, 2) [px]: (y, x) in the mosaic
    spacing [px]: distance of two samples; center: see PSF, of all images

    Raises ValueError for shapes that disagree and positions that are not finite.
    """

    images: np.ndarray
    positions: np.ndarray
    spacing: float = 1.0
    center: object = None
    _triangles: object = field(default=None, repr=False, init=False)

    def __post_init__(self):
        images, positions = np.asarray(self.images), np.asarray(self.positions, dtype=np.float64)
        images = images[:, None] if images.ndim == 3 else images
        if images.ndim != 4 or 0 in images.shape:
            raise ValueError(f"images has the shape {images.shape}, must be (K, C, ny, nx)")
        if positions.shape != (len(images), 2) or not np.isfinite(positions).all():
            raise ValueError(
                f"positions has the shape {positions.shape}, must be ({len(images)}, 2) finite "
                f"numbers for {len(images)} images"
            )
        triangles = None
        if len(images) >= 3:
            from scipy.spatial import Delaunay, QhullError

            try:
                triangles = Delaunay(positions)
            except QhullError:  # all on a line
                triangles = None
        for name, value in (
            ("images", images),
            ("positions", positions),
            ("_triangles", triangles),
        ):
            object.__setattr__(self, name, value)

    @property
    def n_bands(self):
        return self.images.shape[1]

    def psf_at(self, y, x):
        """The images about (y, x) averaged, or the nearest one; see the class."""
        point = np.array(check_position(y, x))
        which, weights = [int(((self.positions - point) ** 2).sum(1).argmin())], np.ones(1)
        simplex = -1 if self._triangles is None else int(self._triangles.find_simplex(point))
        if simplex >= 0:
            which = self._triangles.simplices[simplex]
            transform = self._triangles.transform[simplex]
            first = transform[:2] @ (point - transform[2])
            weights = np.append(first, 1 - first.sum())
        chosen = np.asarray(self.images[which], dtype=np.float64)
        chosen = chosen / chosen.sum(axis=(2, 3), keepdims=True)
        mean = np.einsum("k,kcyx->cyx", weights, chosen)
        return PSF(mean, spacing=self.spacing, center=self.center)


@dataclass(frozen=True, eq=False)
class CellPSF(PSFField):
    """One PSF for each cell of a regular array, constant inside a cell, as in Rubin's coadds.

    images (cells_y, cells_x, C, ny, nx) or (cells_y, cells_x, ny, nx) [1]: pixel response included;
        a cell whose images are not finite or have no light is empty, and replaced by the nearest
        one that is not
    cell_px (2,) [px]: size (y, x) of a cell, or one number
    origin_px (2,) [px]: (y, x) of the first cell's outer corner; (-1/2, -1/2) is that of the mosaic
    spacing [px], center: as in ScatteredPSF

    Raises ValueError for shapes that disagree, cells without a size, and where all are empty.
    """

    images: np.ndarray
    cell_px: object
    origin_px: object = (-0.5, -0.5)
    spacing: float = 1.0
    center: object = None
    _filled: np.ndarray | None = field(default=None, repr=False, init=False)

    def __post_init__(self):
        images = np.asarray(self.images)
        images = images[:, :, None] if images.ndim == 4 else images
        if images.ndim != 5 or 0 in images.shape:
            raise ValueError(
                f"images has the shape {images.shape}, must be (cells_y, cells_x, C, ny, nx)"
            )
        cell = np.broadcast_to(np.asarray(self.cell_px, dtype=np.float64), 2)
        if not (np.isfinite(cell) & (cell > 0)).all():
            raise ValueError(f"cell_px is {self.cell_px}, must be positive numbers of pixels")
        good = np.isfinite(images).all(axis=(2, 3, 4)) & (images.sum(axis=(3, 4)) > 0).all(axis=2)
        if not good.any():
            raise ValueError(f"images: all {good.size} cells are empty")
        object.__setattr__(self, "images", images)
        object.__setattr__(self, "cell_px", cell)
        object.__setattr__(self, "_filled", np.argwhere(good))

    @property
    def n_bands(self):
        return self.images.shape[2]

    def psf_at(self, y, x):
        """The PSF of the cell at (y, x), or of the nearest cell that is not empty."""
        place = (np.array(check_position(y, x)) - self.origin_px) / self.cell_px - 0.5
        nearest = ((self._filled - place) ** 2 * self.cell_px**2).sum(axis=1).argmin()
        row, column = self._filled[nearest]
        return PSF(self.images[row, column], spacing=self.spacing, center=self.center)
