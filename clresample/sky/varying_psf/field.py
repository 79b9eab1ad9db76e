"""Interface of PSFs that vary over an image."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ..psf import PSF


class PSFField(ABC):
    """The PSF of an image at any position.

    n_bands: of the PSFs that it returns; varies: False if they are all equal
    """

    n_bands: int
    varies = True

    @abstractmethod
    def psf_at(self, y, x) -> PSF:
        """The PSF at (y, x) [px]: row and column of the image, the first pixel's centre at (0, 0).

        Outside the image, or where the PSF was not measured, the PSF at the nearest such position
        is returned, so that a source at the edge can be fitted.
        Raises ValueError for positions that are not finite.
        """

    def cutout(self, y0, x0) -> PSFField:
        """The same PSFs over an image whose first pixel is (y0, x0) [px] of this one."""
        return _GridCutout(self, (float(y0), float(x0)))


@dataclass(frozen=True, eq=False)
class _GridCutout(PSFField):
    """The PSFs of `field` for an image that begins at its pixel `origin` (y, x) [px]."""

    field: PSFField
    origin: tuple[float, float]

    @property
    def n_bands(self):
        return self.field.n_bands

    @property
    def varies(self):
        return self.field.varies

    def psf_at(self, y, x):
        return self.field.psf_at(y + self.origin[0], x + self.origin[1])


@dataclass(frozen=True, eq=False)
class FunctionPSF(PSFField):
    """PSF field of a function of the position.

    function: called as function(y, x) [px]; returns a PSF of n_bands, or images accepted by `PSF`,
        (C, ny, nx) or (ny, nx), with the pixel response and one sample per pixel. Worker processes
        require that it can be pickled: it must be defined in a module, not a lambda
    """

    function: object
    n_bands: int = 1

    def psf_at(self, y, x):
        """PSF returned by the function. Raises ValueError for another number of bands."""
        psf = self.function(*check_position(y, x))
        psf = psf if isinstance(psf, PSF) else PSF(psf)
        if psf.n_bands != self.n_bands:
            raise ValueError(
                f"function returned a PSF of {psf.n_bands} bands at (y, x) = ({y:g}, {x:g}), "
                f"n_bands is {self.n_bands}"
            )
        return psf


def check_position(y, x) -> tuple[float, float]:
    """The position as two floats. Raises ValueError where one of them is not finite."""
    if not np.isfinite([y, x]).all():
        raise ValueError(f"psf_at: (y, x) is ({y}, {x}), must be finite")
    return float(y), float(x)
