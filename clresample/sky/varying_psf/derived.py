"""PSF fields derived from another PSF field."""

from __future__ import annotations

from dataclasses import dataclass

from ..correlation import filtered_psf
from .field import PSFField


@dataclass(frozen=True, eq=False)
class RepeatedPSF(PSFField):
    """The one band of `field` for each of n_bands."""

    field: PSFField
    n_bands: int

    @property
    def varies(self):
        return self.field.varies

    def psf_at(self, y, x):
        return self.field.psf_at(y, x).select([0] * self.n_bands)


@dataclass(frozen=True, eq=False)
class FilteredPSF(PSFField):
    """The PSFs of `field` in images convolved with filters (C), as `filtered_psf` has them."""

    field: PSFField
    filters: list

    @property
    def n_bands(self):
        return self.field.n_bands

    def psf_at(self, y, x):
        return filtered_psf(self.field.psf_at(y, x), self.filters)[0]


def filter_psf(psf, psf_field, filters):
    """PSF, or field of PSFs, of images convolved with filters, and the filters' sums (C,).

    See `filtered_psf`.
    """
    found, sums = filtered_psf(psf, filters)
    return found if psf_field is None else FilteredPSF(psf_field, filters), sums
