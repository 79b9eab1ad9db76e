"""Mosaics of sources of several parts, drawn by GalSim under the PSFs of instruments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.grid import Grid
from .galaxies import import_galsim
from .mosaicked import WAVELENGTH_NM, SimulatedMosaic
from .spoilers import add_cosmic_rays, gap_pixels, offset_of, saturate, signed
from .surveys import EUCLID_VIS

# Euclid VIS: a mirror of 1.2 m with 12 % of its area obscured, jitter and charge diffusion of
# 0.03 arcsec, Cropper et al. 2016 (SPIE 9904, 99040Q); Rubin: seeing as Moffat profiles, Trujillo
# et al. 2001 (MNRAS 328, 977)
DIAMETER_M, OBSCURATION, JITTER_ARCSEC = 1.2, 0.35, 0.03
MOFFAT_BETA = 4.765
FWHM_OF_SIGMA = 2.3548
# Halo of the wings missing in the published PSF, about r^-3 (King 1971, PASP 83, 199; Slater et al.
# 2009, PASP 121, 1267).
HALO_BETA, HALO_ARCSEC = 1.5, 3.0  # [1], [arcsec] of a Moffat profile
# [mag] in the band itself: the faintest star with a saturated pixel
SATURATION_MAG = {"Euclid": 17.8, "Rubin": 16.5}
# [noise of a pixel] surface brightness down to which a source is drawn, in every channel
FAINTEST_LIGHT = 0.1
RADII_ARCSEC = np.geomspace(
    0.5, 120, 100
)  # [arcsec] radii at which the surface brightness is tested
# [samples a side] of published PSF images: an Airy pattern has a hundredth of its light beyond
PSF_PX = {"Euclid": 129, "Rubin": 65}
# [px] Spacing of published PSFs: an Airy pattern's highest frequency, D / wavelength = 8.1 per
# arcsec, exceeds the limit of pixels of 0.1 arcsec.
PSF_SPACING = {"Euclid": 0.5, "Rubin": 1.0}
PSF_NODES = 3  # positions along each axis of the samples of a varying PSF
DEAD = 1e6  # [counts] value of invalid pixels
LARGEST_FFT = 16384  # [samples a side] of a drawing


@dataclass(frozen=True, eq=False)
class InstrumentModel:
    """One survey's published and true PSFs, and the true positions of its pixels.

    width (C,): ratio of the published PSF's width to the true one; wings: see Spoilers.psf_wings
    variation: relative growth of the PSF's width across the mosaic, along axis `axis`
    """

    survey: object
    width: np.ndarray
    wings: float = 0.0
    variation: float = 0.0
    axis: int = 0

    def psf(self, band, stretch=1.0):
        """The PSF of a band [0 to C - 1] without its pixel, as a GalSim object."""
        galsim = import_galsim()
        survey = self.survey
        if survey.name == EUCLID_VIS.name:
            wavelength = WAVELENGTH_NM[survey.bands[band]]
            psf = galsim.Airy(lam=wavelength, diam=DIAMETER_M, obscuration=OBSCURATION)
            psf = galsim.Convolve(psf, galsim.Gaussian(sigma=JITTER_ARCSEC))
        else:
            psf = galsim.Moffat(MOFFAT_BETA, fwhm=FWHM_OF_SIGMA * survey.psf_sigma_arcsec[band])
        return psf.dilate(stretch)

    def stretch(self, pixel, shape):
        """The PSF's width at a pixel (y, x) in units of that in the middle."""
        return 1 + self.variation * (pixel[self.axis] / (shape[self.axis] - 1) - 0.5)

    def psf_images(self, grid):
        """Positions (K, 2) [px] and published images (K, C, ny, nx), pixel response included."""
        galsim, survey = import_galsim(), self.survey
        nodes = PSF_NODES if self.variation else 1
        ends = [np.linspace(0, n - 1, nodes) if nodes > 1 else [(n - 1) / 2] for n in grid.shape]
        places = np.array([(y, x) for y in ends[0] for x in ends[1]])
        n_px = PSF_PX[survey.name]
        scale, images = survey.pixel_scale_arcsec, []
        for place in places:
            for band in range(survey.n_bands):
                stretch = self.stretch(place, grid.shape) * (1 + self.width[band])
                whole = galsim.Convolve(self.psf(band, stretch), galsim.Pixel(scale))
                step = scale * PSF_SPACING[survey.name]
                image = whole.drawImage(nx=n_px, ny=n_px, scale=step, method="no_pixel")
                images.append(image.array)
        shape = len(places), survey.n_bands, n_px, n_px
        return places, np.array(images, np.float32).reshape(shape)


def painted(survey, grid, sources, spoilers, rng, center_deg, *, second, **options):
    """The SimulatedMosaic of sources and their squared signal to noise (S,).

    grid: flat Grid of the true pixel positions; second: True if its WCS has an offset
    options: variation, axis, bad_columns
    """
    width = signed(rng, spoilers.psf_width, survey.n_bands)
    offset = offset_of(rng, spoilers.wcs_offset_px) if second else np.zeros(2)
    columns = options.pop("bad_columns", 0)
    instrument = InstrumentModel(survey, width, spoilers.psf_wings, **options)
    data = np.zeros((survey.n_bands, *grid.shape))
    power = np.array([_add(data, instrument, grid, source) for source in sources])
    sigma = survey.noise_sigma
    data += sigma[:, None, None] * rng.standard_normal(data.shape)
    data += (sigma * signed(rng, (spoilers.sky_sigma,) * 2, survey.n_bands))[:, None, None]
    add_cosmic_rays(data, sigma, rng, spoilers.cosmic_rays)
    bad = gap_pixels(grid.shape, rng, spoilers.gaps)
    bad[:, rng.choice(grid.shape[1], columns, replace=False)] = True
    if spoilers.saturation:
        full = _saturated(data, instrument)
        bad |= full & spoilers.mask_saturated
    data[:, bad] = DEAD
    places, images = instrument.psf_images(grid)
    said = Grid.from_jacobian(grid.shape, grid.jacobian, grid.origin + grid.jacobian @ offset)
    placed = Grid.from_wcs(said.to_wcs(ra_deg=center_deg[0], dec_deg=center_deg[1]), grid.shape)
    spacing = PSF_SPACING[survey.name]
    data = data.astype(np.float32)
    return SimulatedMosaic(survey, placed, data, sigma, bad, places, images, spacing), power


def _saturated(data, instrument):
    """Saturates the bands; returns the pixels (Ny, Nx) bool that are saturated in any of them."""
    survey = instrument.survey
    galsim, scale = import_galsim(), survey.pixel_scale_arcsec
    counts = survey.counts(np.full(survey.n_bands, SATURATION_MAG[survey.name]))
    full = np.zeros(data.shape[1:], bool)
    for band, image in enumerate(data):
        pixel = galsim.Convolve(instrument.psf(band), galsim.Pixel(scale))
        peak = pixel.drawImage(nx=3, ny=3, scale=scale, method="no_pixel").array.max()
        full |= saturate(image, counts[band] * float(peak))
    return full


def band_fluxes(source, bands):
    """Fluxes (P, C) of a source's parts in units of its i-band flux."""
    ratio = np.array([WAVELENGTH_NM[band] / WAVELENGTH_NM["i"] for band in bands])
    return np.array([part.fraction * ratio**part.index for part in source.parts])


def _add(data, instrument, grid, source):
    """Draws a source, adds it to images in place and returns its squared signal to noise."""
    galsim, survey, power = import_galsim(), instrument.survey, 0.0
    pixel = np.linalg.solve(grid.jacobian, source.position - grid.origin)
    share = band_fluxes(source, survey.bands)
    counts = share * survey.counts(np.full(survey.n_bands, source.mag_i))
    half = int(np.ceil(_reach(source, counts, instrument) / survey.pixel_scale_arcsec))
    low = np.maximum(np.rint(pixel).astype(int) - half, 0)
    high = np.minimum(np.rint(pixel).astype(int) + half + 1, grid.shape)
    if (high <= low).any():
        return power
    (y_row, y_col), (x_row, x_col) = grid.jacobian  # [arcsec/px]
    stretch = instrument.stretch(np.clip(pixel, 0, np.array(grid.shape) - 1), grid.shape)
    params = galsim.GSParams(maximum_fft_size=LARGEST_FFT)
    halo = instrument.wings if source.kind == "star" else 0.0
    far = halo and halo * _halo(grid, source.position, low, high)
    for band in range(survey.n_bands):
        light = galsim.Add(
            [part.profile * flux for part, flux in zip(source.parts, counts[:, band], strict=True)]
        )
        light = galsim.Convolve(light, instrument.psf(band, stretch)).withGSParams(params)
        image = galsim.ImageD(int(high[1] - low[1]), int(high[0] - low[0]), xmin=0, ymin=0)
        image.wcs = galsim.JacobianWCS(x_col, x_row, y_col, y_row)
        light.drawImage(image, center=galsim.PositionD(pixel[1] - low[1], pixel[0] - low[0]))
        seen = (1 - halo) * image.array + counts[:, band].sum() * far
        data[band, low[0] : high[0], low[1] : high[1]] += seen
        power += float((seen**2).sum()) / survey.noise_sigma[band] ** 2
    return power


def _halo(grid, position, low, high):
    """Light (Ny, Nx) [1/px] of a halo of unit flux about a position [arcsec], on a stamp."""
    y, x = (np.arange(a, b, dtype=float) for a, b in zip(low, high, strict=True))
    sky = grid.jacobian @ np.stack(np.meshgrid(y, x, indexing="ij")).reshape(2, -1)
    radius2 = ((sky + (grid.origin - position)[:, None]) ** 2).sum(axis=0)
    scale2 = HALO_ARCSEC**2
    light = (HALO_BETA - 1) / (np.pi * scale2) * (1 + radius2 / scale2) ** -HALO_BETA
    return abs(np.linalg.det(grid.jacobian)) * light.reshape(len(y), len(x))


def _reach(source, counts, instrument):
    """Radius [arcsec] within which a source is above FAINTEST_LIGHT in some channel."""
    survey, galsim = instrument.survey, import_galsim()
    pixel = survey.pixel_scale_arcsec**2
    reach, wings = 1.0, instrument.wings if source.kind == "star" else 0.0
    unit = (HALO_BETA - 1) / (np.pi * HALO_ARCSEC**2)
    halo = unit * (1 + (RADII_ARCSEC / HALO_ARCSEC) ** 2) ** -HALO_BETA
    for band, (flux, sigma) in enumerate(zip(counts.sum(axis=0), survey.noise_sigma, strict=True)):
        profiles = [_envelope(instrument, band)]
        if source.n:
            profiles.append(galsim.Sersic(source.n, half_light_radius=source.size_arcsec))
        for profile in profiles:
            light = np.array([profile.xValue(r, 0.0) for r in RADII_ARCSEC]) + wings * halo
            seen = RADII_ARCSEC[flux * pixel * light > FAINTEST_LIGHT * sigma]
            reach = max(reach, seen.max(initial=0.0))
    return reach * 1.2


def _envelope(instrument, band):
    """A profile whose wings are those of the PSF."""
    galsim, survey = import_galsim(), instrument.survey
    if survey.name == EUCLID_VIS.name:
        wavelength = WAVELENGTH_NM[survey.bands[band]]
        return galsim.Airy(lam=wavelength, diam=DIAMETER_M, obscuration=OBSCURATION)
    return instrument.psf(band)
