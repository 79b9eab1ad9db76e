"""The surveys of the paper: pixels, PSFs, and magnitudes turned into counts and noise.

Three tables: the five surveys with the paper's printed values (`PAPER_SURVEYS`), with those of its
notebooks (`NOTEBOOK_SURVEYS`: two of the printed sigmas seem to be full widths at half maximum),
and the two instruments of its blended scenes (`EUCLID_VIS`, `RUBIN_UGRIZY`).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..sky.grid import Grid
from ..sky.psf import PSF

MAGNITUDE_OF_ZERO_POINT = 24.0  # [mag] a zero point is the count rate [1/s] of a source this bright
PSF_PIXELS = 41  # [pixels a side] of every PSF image in the paper's tests


@dataclass(frozen=True)
class Survey:
    """One instrument: square pixels, Gaussian PSFs and, where known, its photometry.

        counts(m) = exposure * zero point * 10^(-0.4 (m - 24))
        variance of a pixel = counts(sky) * pixel^2                  sky [mag/arcsec^2]

    name: of the survey
    pixel_scale_arcsec [arcsec]: side of a pixel
    bands (C,): names of the channels
    psf_sigma_arcsec (C,) [arcsec]: standard deviation of the PSF before the pixel
    exposure_s (C,) [s], zero_point (C,) [counts/s at magnitude 24], sky_mag (C,) [mag/arcsec^2]:
        photometry; None where unknown

    Raises ValueError where a column's length is not that of `bands`, or a scale or width is not
    positive.
    Source: Tables `tab:resolutions` and `tab:sim_param`.
    """

    name: str
    pixel_scale_arcsec: float
    bands: tuple
    psf_sigma_arcsec: tuple
    exposure_s: tuple | None = None
    zero_point: tuple | None = None
    sky_mag: tuple | None = None

    def __post_init__(self):
        if not self.pixel_scale_arcsec > 0:
            raise ValueError(f"pixel_scale_arcsec is {self.pixel_scale_arcsec}, must be above 0")
        for column in ("psf_sigma_arcsec", "exposure_s", "zero_point", "sky_mag"):
            values = getattr(self, column)
            if values is not None and len(values) != len(self.bands):
                raise ValueError(f"{column} has {len(values)} entries for {len(self.bands)} bands")
        if not min(self.psf_sigma_arcsec) > 0:
            raise ValueError(f"psf_sigma_arcsec is {self.psf_sigma_arcsec}, must be above 0")

    @property
    def n_bands(self):
        return len(self.bands)

    def counts(self, magnitudes):
        """Counts over the exposure of sources of given magnitudes.

        magnitudes (..., C) [mag]: one for each band. Returns (..., C) [counts].
        Raises ValueError where the survey has no photometry.
        """
        rate = self._photometry("zero_point") * self._photometry("exposure_s")
        return rate * 10 ** (-0.4 * (np.asarray(magnitudes, float) - MAGNITUDE_OF_ZERO_POINT))

    @property
    def zero_points_mag(self):
        """(C,) [mag]: magnitude of a source of one count over the exposure."""
        return 2.5 * np.log10(self.counts(np.zeros(self.n_bands)))

    @property
    def noise_sigma(self):
        """(C,) [counts]: standard deviation of the sky's noise in one pixel."""
        return np.sqrt(self.counts(self._photometry("sky_mag"))) * self.pixel_scale_arcsec

    def psf(self, n_pixels=PSF_PIXELS):
        """The PSF of every band, pixel response included, as `n_pixels` x `n_pixels` images."""
        sigmas_px = np.asarray(self.psf_sigma_arcsec) / self.pixel_scale_arcsec
        return PSF.gaussian(sigmas_px, n_pixels=n_pixels)

    def grid(self, n_pixels, *, angle_deg=0.0, flip=False):
        """Square stamp of `n_pixels` a side whose centre is the origin of the flat sky."""
        return Grid.flat(
            (n_pixels, n_pixels), self.pixel_scale_arcsec, angle_deg=angle_deg, flip=flip
        )

    def n_same_sky(self, n_pixels, other):
        """Whole pixels of this survey, a side, in the sky of `n_pixels` of survey `other`."""
        ratio = other.pixel_scale_arcsec / self.pixel_scale_arcsec
        return int(n_pixels * ratio + 1e-6)  # pixels: 100 x 0.06 / 0.2 is 30, not 29.999...

    def _photometry(self, column):
        values = getattr(self, column)
        if values is None:
            raise ValueError(f"survey {self.name} has no {column}: its photometry is not tabulated")
        return np.asarray(values, float)


def _one_band(**surveys):
    return MappingProxyType(
        {name: Survey(name, pixel, (name,), (sigma,)) for name, (pixel, sigma) in surveys.items()}
    )


# pixel scale [arcsec], PSF sigma [arcsec]
PAPER_SURVEYS = _one_band(
    HST=(0.06, 0.074), EUCLID=(0.1, 0.16), ROMAN=(0.11, 0.186), HSC=(0.167, 0.62), RUBIN=(0.2, 0.7)
)
NOTEBOOK_SURVEYS = _one_band(
    HST=(0.06, 0.074),
    EUCLID=(0.101, 0.16),
    ROMAN=(0.11, 0.2046),
    HSC=(0.167, 0.285),
    RUBIN=(0.2, 0.297),
)

EUCLID_VIS = Survey(
    name="Euclid",
    pixel_scale_arcsec=0.101,
    bands=("VIS",),
    psf_sigma_arcsec=(0.16,),
    exposure_s=(2260.0,),
    zero_point=(6.85,),
    sky_mag=(22.9,),
)
RUBIN_UGRIZY = Survey(
    name="Rubin",
    pixel_scale_arcsec=0.2,
    bands=("u", "g", "r", "i", "z", "y"),
    psf_sigma_arcsec=(0.327, 0.31, 0.297, 0.285, 0.276, 0.267),
    exposure_s=(1680.0, 2400.0, 5520.0, 5520.0, 4800.0, 4800.0),
    zero_point=(9.16, 50.70, 43.70, 32.36, 22.68, 10.58),
    sky_mag=(22.9, 22.3, 21.3, 20.5, 19.6, 18.6),
)
