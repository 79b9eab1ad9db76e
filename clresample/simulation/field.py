"""A field of galaxies and stars as Euclid and Rubin see it, with the truth: mosaics, not stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..sky.grid import Grid
from ..sky.psf import PSF
from .galaxies import draw, import_galsim, parametric_galaxy
from .scenes import POWER_LAW_INDEX, RUBIN_WAVELENGTHS_NM
from .surveys import EUCLID_VIS, PSF_PIXELS, RUBIN_UGRIZY, Survey

WAVELENGTH_NM = dict(zip(RUBIN_UGRIZY.bands, RUBIN_WAVELENGTHS_NM, strict=True)) | {"VIS": 715.0}
# [mag] brightest i magnitude, and dex per magnitude of the number counts, as of galaxies of i 20-26
BRIGHTEST, COUNTS_SLOPE = 18.0, 0.32
# [arcsec] half side of the stamp that a source is drawn on, down to each i magnitude: beyond it the
# light of a source as bright is under a tenth of the deepest noise
STAMP_ARCSEC = ((20.0, 15.0), (22.0, 10.0), (24.0, 6.0), (99.0, 4.0))
CLUSTER_ARCSEC = 1.5  # scatter of a companion's position about its host, in y and in x
PSF_NODES = 5  # places along each axis at which the PSF cube of a mosaic is given


@dataclass(frozen=True, eq=False)
class SimulatedMosaic:
    """One instrument's mosaic.

    survey: the instrument; grid: Grid with a WCS
    data (C, Ny, Nx) [counts]: float32; noise_sigma (C,) [counts]: of every pixel
    bad (Ny, Nx) bool: columns whose pixels are worthless
    psf_positions (K, 2) [px], psf_images (K, C, ny, nx): the PSF where it is given
    """

    survey: Survey
    grid: Grid
    data: np.ndarray
    noise_sigma: np.ndarray
    bad: np.ndarray
    psf_positions: np.ndarray
    psf_images: np.ndarray


@dataclass(frozen=True, eq=False)
class SimulatedField:
    """A field with its truth.

    mosaics: of Euclid and Rubin
    truth: {column: array (S,)}: ra, dec [deg]; y, x [px of the first mosaic]; snr, the signal to
        noise of the best possible filter over all mosaics and channels; kind "galaxy" or
        "star"; host, the number of the source that it was put beside, -1 for none; mag_* and flux_*
        [mag, uJy] of each channel
    """

    mosaics: tuple[SimulatedMosaic, ...]
    truth: dict


def simulate_field(
    seed,
    *,
    n_pixels=512,
    density=36.0,
    faintest=26.0,
    rubin_bands=RUBIN_UGRIZY.bands,
    angle_deg=12.0,
    clustering=0.2,
    stars=0.05,
    psf_variation=0.0,
    bad_columns=0,
    center_deg=(150.0, 2.0),
) -> SimulatedField:
    """A field as Euclid VIS and Rubin see it; one seed gives one field.

    seed: whole number; n_pixels: of Euclid a side; Rubin's mosaic holds the same sky
    density [arcmin^-2]: of sources with i < `faintest` [mag]
    rubin_bands: some of u g r i z y
    angle_deg [deg]: by which Rubin's pixels are turned
    clustering: part of the sources that lie beside another one, 1.5 arcsec away or so
    stars: part of the sources that are stars
    psf_variation: by which part the PSF's width grows from the left edge to the right one; Rubin's
        from the lower to the upper
    bad_columns: of each mosaic that hold nothing
    center_deg (2,) [deg]: right ascension and declination of the field's centre

    Galaxies are parametric ones (`parametric_galaxy`) with power-law spectra. Needs GalSim.

    Raises ValueError for numbers out of range; ImportError, with what to install, without GalSim.
    """
    _check(n_pixels, density, faintest, clustering, stars, psf_variation, bad_columns, rubin_bands)
    source_rng, *rngs = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    surveys = EUCLID_VIS, _with_bands(RUBIN_UGRIZY, rubin_bands)
    side = n_pixels * EUCLID_VIS.pixel_scale_arcsec
    sources = _sources(source_rng, side, density, faintest, clustering, stars)
    turns = np.radians(angle_deg)
    reach = abs(np.cos(turns)) + abs(np.sin(turns))
    n_rubin = int(np.ceil(side * reach / RUBIN_UGRIZY.pixel_scale_arcsec))
    grids = EUCLID_VIS.grid(n_pixels), surveys[1].grid(n_rubin, angle_deg=angle_deg)
    mosaics, powers = zip(
        *(
            _mosaic(survey, grid, sources, rng, psf_variation, axis, bad_columns, center_deg)
            for survey, grid, rng, axis in zip(surveys, grids, rngs, (1, 0), strict=True)
        ),
        strict=True,
    )
    truth = _truth(sources, surveys, grids[0], mosaics[0].grid)
    return SimulatedField(mosaics, truth | {"snr": np.sqrt(sum(powers))})


def _check(n_pixels, density, faintest, clustering, stars, psf_variation, bad_columns, rubin_bands):
    """Raise ValueError for what `simulate_field` does not take."""
    for name, value, good in (
        ("n_pixels", n_pixels, n_pixels >= 32),
        ("density", density, density > 0),
        ("faintest", faintest, faintest > BRIGHTEST),
        ("clustering", clustering, 0 <= clustering <= 1),
        ("stars", stars, 0 <= stars <= 1),
        ("psf_variation", psf_variation, 0 <= psf_variation < 1),
        ("bad_columns", bad_columns, bad_columns >= 0),
    ):
        if not good:
            raise ValueError(f"{name} is {value}, out of its range")
    unknown = [band for band in rubin_bands if band not in RUBIN_UGRIZY.bands]
    if unknown or not rubin_bands:
        raise ValueError(f"rubin_bands is {rubin_bands}, some of {RUBIN_UGRIZY.bands} are taken")


def _with_bands(survey, bands):
    chosen = [survey.bands.index(band) for band in bands]
    columns = ("bands", "psf_sigma_arcsec", "exposure_s", "zero_point", "sky_mag")
    return replace(survey, **{c: tuple(getattr(survey, c)[i] for i in chosen) for c in columns})


@dataclass(frozen=True, eq=False)
class _Sources:
    """Positions (S, 2) [arcsec], i magnitudes, spectral indices, kinds, hosts, profiles (S)."""

    positions: np.ndarray
    mag_i: np.ndarray
    index: np.ndarray
    kind: list
    host: np.ndarray
    profiles: list

    def magnitudes(self, band):
        """(S,) [mag] of a spectrum f_nu ~ wavelength^index."""
        ratio = WAVELENGTH_NM[band] / WAVELENGTH_NM["i"]
        return self.mag_i - 2.5 * self.index * np.log10(ratio)


def _sources(rng, side, density, faintest, clustering, stars):
    galsim = import_galsim()
    n = int(rng.poisson(density * (side / 60) ** 2))
    steps = rng.uniform(10 ** (COUNTS_SLOPE * (BRIGHTEST - faintest)), 1, n)
    mag = faintest + np.log10(steps) / COUNTS_SLOPE
    positions = rng.uniform(-side / 2, side / 2, (n, 2))
    host, kind, profiles = np.full(n, -1), [], []
    for i in range(n):
        if i and rng.uniform() < clustering:
            host[i] = rng.integers(i)
            positions[i] = positions[host[i]] + rng.normal(0, CLUSTER_ARCSEC, 2)
        star = rng.uniform() < stars
        kind.append("star" if star else "galaxy")
        profiles.append(galsim.DeltaFunction() if star else parametric_galaxy(rng))
    index = rng.normal(*POWER_LAW_INDEX, n)
    return _Sources(positions, mag, index, kind, host, profiles)


def _mosaic(survey, grid, sources, rng, variation, axis, n_bad, center_deg):
    data = np.zeros((survey.n_bands, *grid.shape))
    magnitudes = np.stack([sources.magnitudes(band) for band in survey.bands], axis=1)
    counts = survey.counts(magnitudes)
    sigma, power = survey.noise_sigma, np.zeros(len(sources.profiles))
    for s in range(len(power)):
        power[s] = _add(data, survey, grid, sources, s, counts[s], variation, axis)
    data += sigma[:, None, None] * rng.standard_normal(data.shape)
    bad = np.zeros(grid.shape, bool)
    bad[:, rng.choice(grid.shape[1], n_bad, replace=False)] = True
    data[:, bad] = 1e6  # what a dead column holds: no light
    nodes = [np.linspace(0, n - 1, PSF_NODES) for n in grid.shape]
    places = np.array([(y, x) for y in nodes[0] for x in nodes[1]])
    images = np.stack([_psf(survey, _width(grid, p, variation, axis)) for p in places])
    placed = Grid.from_wcs(grid.to_wcs(ra_deg=center_deg[0], dec_deg=center_deg[1]), grid.shape)
    images = images.astype(np.float32)
    mosaic = SimulatedMosaic(survey, placed, data.astype(np.float32), sigma, bad, places, images)
    return mosaic, power


def _width(grid, pixel, variation, axis):
    """The PSF's width at a pixel (y, x), in units of the survey's: 1 in the middle."""
    return 1 + variation * (pixel[axis] / (grid.shape[axis] - 1) - 0.5)


def _psf(survey, width):
    sigmas = width * np.asarray(survey.psf_sigma_arcsec) / survey.pixel_scale_arcsec
    return PSF.gaussian(sigmas, n_pixels=PSF_PIXELS).images


def _add(data, survey, grid, sources, s, counts, variation, axis):
    """Draw a source on its stamp and add it to the mosaic; returns its squared signal to noise."""
    profile, position, power = sources.profiles[s], sources.positions[s], 0.0
    pixel = np.linalg.solve(grid.jacobian, position - grid.origin)
    reach = next(half for limit, half in STAMP_ARCSEC if sources.mag_i[s] < limit)
    half = int(np.ceil(reach / survey.pixel_scale_arcsec))
    low = np.maximum(np.rint(pixel).astype(int) - half, 0)
    high = np.minimum(np.rint(pixel).astype(int) + half + 1, grid.shape)
    if (high <= low).any():
        return power
    stamp = grid.cutout(*low, tuple(high - low))
    width = _width(grid, pixel, variation, axis)
    for c, sigma in enumerate(survey.psf_sigma_arcsec):
        image = draw(profile, stamp, psf_sigma_arcsec=width * sigma, position_arcsec=position)
        data[c, low[0] : high[0], low[1] : high[1]] += counts[c] * image
        power += float(((counts[c] * image) ** 2).sum() / survey.noise_sigma[c] ** 2)
    return power


def _truth(sources, surveys, grid, placed):
    pixels = np.linalg.solve(grid.jacobian, (sources.positions - grid.origin).T)
    ra, dec = placed.sky(*pixels)
    truth = {"ra": ra, "dec": dec, "y": pixels[0], "x": pixels[1], "host": sources.host}
    truth["kind"] = np.array(sources.kind, dtype="U6")
    for band in (band for survey in surveys for band in survey.bands):
        mag = sources.magnitudes(band)
        truth[f"mag_{band}"], truth[f"flux_{band}"] = mag, 10 ** (-0.4 * (mag - 23.9))
    return truth
