"""What every PSF that varies over a mosaic answers, and the two simplest: constant, a function."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ...sky.psf import PSF


class PSFField(ABC):
    """The PSF of a mosaic wherever it is asked for.

    n_bands: of the PSFs that it returns
    """

    n_bands: int

    @abstractmethod
    def psf_at(self, y, x) -> PSF:
        """The PSF at (y, x) [px]: row and column of the mosaic, the first pixel's centre at (0, 0).

        Outside the mosaic, or where the PSF was not measured, that of the nearest place is
        returned, so that a source at the edge can be fitted.
        Raises ValueError for positions that are not finite.
        """


@dataclass(frozen=True, eq=False)
class ConstantPSF(PSFField):
    """The same PSF everywhere."""

    psf: PSF

    @property
    def n_bands(self):
        return self.psf.n_bands

    def psf_at(self, y, x):
        """`psf`, wherever (y, x) is."""
        finite(y, x)
        return self.psf


@dataclass(frozen=True, eq=False)
class FunctionPSF(PSFField):
    """What a function of the position returns.

    function: called as function(y, x) [px]; returns a PSF of n_bands, or images that `PSF` takes,
        (C, ny, nx) or (ny, nx), with the pixel response and one sample per pixel. To be sent to
        worker processes it must be one that `pickle` takes: defined in a module, not a lambda
    """

    function: object
    n_bands: int = 1

    def psf_at(self, y, x):
        """PSF of the function's answer. Raises ValueError for another number of bands."""
        psf = self.function(*finite(y, x))
        psf = psf if isinstance(psf, PSF) else PSF(psf)
        if psf.n_bands != self.n_bands:
            raise ValueError(
                f"function returned a PSF of {psf.n_bands} bands at (y, x) = ({y:g}, {x:g}), "
                f"n_bands is {self.n_bands}"
            )
        return psf


@dataclass(frozen=True, eq=False, init=False)
class BandPSFs(PSFField):
    """One PSF field for each band of an instrument, of one band each.

    fields: at least one PSFField of one band. Their samples must have one distance; smaller stamps
        are filled up with zeros about their centres

    Raises ValueError for fields of several bands.
    """

    fields: tuple[PSFField, ...]

    def __init__(self, fields):
        fields = tuple(fields)
        bands = [field.n_bands for field in fields]
        if not fields or set(bands) != {1}:
            raise ValueError(f"fields have {bands} bands, it takes one or more with one band each")
        object.__setattr__(self, "fields", fields)

    @property
    def n_bands(self):
        return len(self.fields)

    def psf_at(self, y, x):
        """The bands' PSFs in one. Raises ValueError where their samples' distances differ."""
        return stacked([field.psf_at(y, x) for field in self.fields])


def stacked(psfs) -> PSF:
    """One PSF of several, their bands in order; stamps are filled up with zeros to one size.

    Raises ValueError where the distances of their samples differ.
    """
    spacings = [psf.spacing for psf in psfs]
    if len(set(spacings)) > 1:
        raise ValueError(
            f"psfs have samples {spacings} px apart, bands of one PSF share a distance"
        )
    shape = np.max([psf.images.shape[1:] for psf in psfs], axis=0)
    images, centers = [], []
    for psf in psfs:
        before = (shape - psf.images.shape[1:]) // 2
        after = shape - psf.images.shape[1:] - before
        images.append(np.pad(psf.images, [(0, 0), *zip(before, after, strict=True)]))
        centers.append(psf.center + before)
    return PSF.restore(np.concatenate(images), spacing=spacings[0], center=np.concatenate(centers))


def finite(y, x) -> tuple[float, float]:
    """The position as two floats. Raises ValueError where one of them is not finite."""
    if not np.isfinite([y, x]).all():
        raise ValueError(f"psf_at was asked for (y, x) = ({y}, {x}), it takes finite numbers")
    return float(y), float(x)
