"""Simulated fields as data: mosaics of two surveys and the truth that drew them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..sky.grid import Grid
from .scenes import RUBIN_WAVELENGTHS_NM
from .surveys import RUBIN_UGRIZY, Survey

WAVELENGTH_NM = dict(zip(RUBIN_UGRIZY.bands, RUBIN_WAVELENGTHS_NM, strict=True)) | {"VIS": 715.0}


@dataclass(frozen=True, eq=False)
class SimulatedMosaic:
    """One instrument's mosaic.

    survey: the instrument; grid: Grid with a WCS
    data (C, Ny, Nx) [counts]: float32; noise_sigma (C,) [counts]: of every pixel
    bad (Ny, Nx) bool: invalid pixels: dead columns, gaps, saturated cores
    psf_positions (K, 2) [px], psf_images (K, C, ny, nx): the PSF at K positions
    psf_spacing [px]: distance of two samples of the PSF images
    """

    survey: Survey
    grid: Grid
    data: np.ndarray
    noise_sigma: np.ndarray
    bad_pixels: np.ndarray
    psf_positions: np.ndarray
    psf_images: np.ndarray
    psf_spacing: float = 1.0


@dataclass(frozen=True, eq=False)
class SimulatedField:
    """A field with its truth.

    mosaics: of Euclid and Rubin
    truth: {column: array (S,)}: ra, dec [deg]; y, x [px of the first mosaic]; snr, the signal to
        noise of the best possible filter over all mosaics and channels; kind "galaxy" or
        "star"; host, the number of the source beside which it was placed, -1 for none; mag_* and
        flux_* [mag, uJy] of each channel, those of a galaxy with all of its clumps
        clumps: {column: array (K,)}: the clumps of galaxies, which are not sources: group, the
            number in truth of the galaxy; ra, dec [deg]; y, x [px of the first mosaic]; flux_*
            [uJy] of each channel. Empty for fields without a list of clumps
    """

    mosaics: tuple[SimulatedMosaic, ...]
    truth: dict
    clumps: dict = field(default_factory=dict)


def with_bands(survey, bands) -> Survey:
    """The survey with some of its bands."""
    chosen = [survey.bands.index(band) for band in bands]
    columns = ("bands", "psf_sigma_arcsec", "exposure_s", "zero_point", "sky_mag")
    return replace(survey, **{c: tuple(getattr(survey, c)[i] for i in chosen) for c in columns})
