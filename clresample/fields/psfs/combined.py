"""Two PSF fields made of others: one PSF that is the same everywhere, a field for each band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.psf import PSF
from ...sky.varying_psf.field import PSFField, check_position


@dataclass(frozen=True, eq=False)
class ConstantPSF(PSFField):
    """The same PSF everywhere."""

    psf: PSF
    varies = False

    @property
    def n_bands(self):
        return self.psf.n_bands

    def psf_at(self, y, x):
        """`psf`, wherever (y, x) is."""
        check_position(y, x)
        return self.psf


@dataclass(frozen=True, eq=False, init=False)
class PerBandPSF(PSFField):
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
            raise ValueError(f"fields have {bands} bands, must be one or more with one band each")
        object.__setattr__(self, "fields", fields)

    @property
    def n_bands(self):
        return len(self.fields)

    @property
    def varies(self):
        return any(field.varies for field in self.fields)

    def psf_at(self, y, x):
        """The bands' PSFs in one. Raises ValueError where their samples' distances differ."""
        return stack_bands([field.psf_at(y, x) for field in self.fields])


def stack_bands(psfs) -> PSF:
    """One PSF of several, their bands in order; stamps are filled up with zeros to one size.

    Raises ValueError where the distances of their samples differ.
    """
    spacings = [psf.spacing for psf in psfs]
    if len(set(spacings)) > 1:
        raise ValueError(
            f"PSFs have sample spacings {spacings} px; all bands of a PSF must have the same"
        )
    shape = np.max([psf.images.shape[1:] for psf in psfs], axis=0)
    images, centers = [], []
    for psf in psfs:
        before = (shape - psf.images.shape[1:]) // 2
        after = shape - psf.images.shape[1:] - before
        images.append(np.pad(psf.images, [(0, 0), *zip(before, after, strict=True)]))
        centers.append(psf.center + before)
    return PSF.restore(np.concatenate(images), spacing=spacings[0], center=np.concatenate(centers))
