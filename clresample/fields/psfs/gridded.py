"""PSFs on a regular grid of places, as photutils' GriddedPSFModel holds them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...files.atomic import FileError
from ...sky.psf import PSF
from ...sky.varying_psf.field import PSFField, check_position


@dataclass(frozen=True, eq=False)
class GriddedPSF(PSFField):
    """PSF images at the crossings of rows and columns, with bilinear interpolation in between.

    Beyond the outermost rows and columns the PSF is that of the nearest place on them.

    images (n_y, n_x, ny, nx) [1]: pixel response included
    y (n_y,), x (n_x,) [px]: of the rows and columns, ascending
    spacing [px]: distance of two samples; center: see PSF, of all images

    Raises ValueError for shapes that disagree, and rows or columns that do not ascend.
    """

    images: np.ndarray
    y: np.ndarray
    x: np.ndarray
    spacing: float = 1.0
    center: object = None
    n_bands = 1

    def __post_init__(self):
        images = np.asarray(self.images, np.float64)
        y, x = (np.asarray(along, np.float64) for along in (self.y, self.x))
        if images.ndim != 4 or images.shape[:2] != (y.size, x.size):
            raise ValueError(
                f"images has the shape {images.shape}, must be (n_y, n_x, ny, nx) with "
                f"{y.size} rows and {x.size} columns"
            )
        for name, along in (("y", y), ("x", x)):
            if not np.isfinite(along).all() or not (np.diff(along) > 0).all():
                raise ValueError(f"{name} is {along.tolist()}, must be finite and ascend")
        images = images / images.sum(axis=(2, 3), keepdims=True)
        for name, value in (("images", images), ("y", y), ("x", x)):
            object.__setattr__(self, name, value)

    @classmethod
    def of_model(cls, model) -> GriddedPSF:
        """Converts a photutils.psf.GriddedPSFModel to a PSF field.

        Its effective PSFs hold the pixel response, centred on their images.

        Raises ValueError for another object, for positions that make no grid, and where the model
        is oversampled differently along its axes.
        """
        try:
            data, places = np.asarray(model.data), np.asarray(model.grid_xypos, np.float64)
            factors = {float(f) for f in np.ravel(model.oversampling)}
        except AttributeError as error:
            raise ValueError(
                f"model is {type(model).__name__}, must be a GriddedPSFModel of photutils"
            ) from error
        if len(factors) > 1:
            raise ValueError(f"oversampling is {sorted(factors)}, must be one for both axes")
        x, y = (np.unique(along) for along in places.T)
        if len(places) != x.size * y.size or data.shape[0] != len(places):
            raise ValueError(
                f"grid_xypos has {len(places)} places for {len(data)} PSFs, on {y.size} rows and "
                f"{x.size} columns: they make no grid"
            )
        order = np.lexsort(places.T)  # by y, and then by x
        images = data[order].reshape(y.size, x.size, *data.shape[1:])
        return cls(images, y, x, spacing=1 / factors.pop())

    def psf_at(self, y, x):
        """The mean of the four places about (y, x)."""
        y, x = check_position(y, x)
        (row, below, above), (column, left, right) = _between(self.y, y), _between(self.x, x)
        rows = below * self.images[row] + (above * self.images[row + 1] if above else 0)
        mean = left * rows[column] + (right * rows[column + 1] if right else 0)
        return PSF(mean, spacing=self.spacing, center=self.center)


def _between(along, at):
    """The last of the places `along` (n,) at or before `at`, and the shares of it and the next."""
    at = min(max(at, along[0]), along[-1])
    i = int(np.searchsorted(along, at, side="right")) - 1
    if along[i] == at:
        return i, 1.0, 0.0
    part = (at - along[i]) / (along[i + 1] - along[i])
    return i, 1 - part, part


def read_gridded(path, *, detector=None) -> GriddedPSF:
    """Reads a file of `photutils.psf.GriddedPSFModel.read` as a PSF field.

    STDPSF of HST and JWST, and the grids that STPSF (WebbPSF) writes; detector: its number, of
    STDPSF files that have several.

    Raises FileError for other files, ImportError without photutils.
    """
    try:
        from photutils.psf import GriddedPSFModel
    except ImportError as error:
        raise ImportError(
            "files of gridded PSFs need photutils, which is not installed: pip install photutils"
        ) from error
    given = {} if detector is None else {"detector_id": detector}
    try:
        return GriddedPSF.of_model(GriddedPSFModel.read(str(path), **given))
    except Exception as error:  # a damaged file may provoke any exception in photutils
        reason = " ".join(str(error).split())
        raise FileError(f"{path}: no file of gridded PSFs ({reason})") from error
