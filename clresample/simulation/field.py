"""Simulates a field of galaxies and stars by Euclid and Rubin, with its truth, as mosaics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.grid import Grid
from ..sky.psf import PSF
from .galaxies import draw, import_galsim, parametric_galaxy
from .mosaicked import WAVELENGTH_NM, SimulatedField, SimulatedMosaic, with_bands
from .real_sky import painted_field, sky_sources, spoilers_of
from .scenes import POWER_LAW_INDEX
from .surveys import EUCLID_VIS, PSF_PIXELS, RUBIN_UGRIZY

SKIES = "plain", "real", "bright"
# [mag] brightest i magnitude, and dex per magnitude of the number counts, as of galaxies of i 20-26
BRIGHTEST, COUNTS_SLOPE = 18.0, 0.32
# [arcsec] Half side of a source's stamp, down to each i magnitude: beyond it the light of such a
# source is under a tenth of the lowest noise.
STAMP_ARCSEC = ((20.0, 15.0), (22.0, 10.0), (24.0, 6.0), (99.0, 4.0))
CLUSTER_ARCSEC = 1.5  # scatter of a companion's position about its host, in y and in x
PSF_NODES = 5  # positions along each axis of a mosaic's PSF samples


def simulate_field(
    seed,
    *,
    sky="plain",
    spoilers=None,
    n_large=0,
    n_pixels=512,
    density=None,
    faintest=26.0,
    rubin_bands=RUBIN_UGRIZY.bands,
    angle_deg=12.0,
    clustering=0.2,
    stars=None,
    psf_variation=0.0,
    bad_columns=0,
    center_deg=(150.0, 2.0),
) -> SimulatedField:
    """Simulates a field of Euclid VIS and Rubin; one seed gives one field.

    seed: whole number; n_pixels: of Euclid a side; Rubin's mosaic holds the same sky
    sky: "plain", small parametric galaxies (`parametric_galaxy`) under Gaussian PSFs; "real",
        numbers and sizes as published (counts.py), galaxies to 20 arcsec with bars, arms and
        clumps, ellipticals to n = 6, stars that saturate, under an Airy PSF (Euclid) and Moffat
        profiles (Rubin); "bright", six galaxies of half-light radii of 8 to 30 Euclid pixels among
        160 small ones and five stars, one of them saturated, in 1024 x 1024 pixels
    spoilers: Spoilers of the images of another sky than "plain"; None = all of them for "real",
        masked saturation alone for "bright"
    n_large: galaxies of 2 to 20 arcsec that are added to a "real" sky, where they are rare
    density [arcmin^-2]: of sources with i < `faintest` [mag]; None = 36, for "real" as published
    rubin_bands: some of u g r i z y
    angle_deg [deg]: by which Rubin's pixels are turned
    clustering: fraction of the sources that lie beside another one, about 1.5 arcsec away
    stars: fraction of the sources that are stars; None = 0.05, for "real" as published
    psf_variation: relative growth of the PSF's width from the left edge to the right edge, Rubin's
        from the lower edge to the upper edge
    bad_columns: number of dead columns of each mosaic
    center_deg (2,) [deg]: right ascension and declination of the field's centre

    Spectra are power laws. "bright" takes no density, faintest, clustering and stars. Needs GalSim.

    Raises ValueError for numbers out of range; ImportError, with what to install, without GalSim.
    """
    density, stars = _defaults(sky, spoilers, n_large, density, stars)
    _check(n_pixels, density, faintest, clustering, stars, psf_variation, bad_columns, rubin_bands)
    source_rng, *rngs = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    surveys = EUCLID_VIS, with_bands(RUBIN_UGRIZY, rubin_bands)
    side = n_pixels * EUCLID_VIS.pixel_scale_arcsec
    grids = _grids(surveys, n_pixels, angle_deg)
    if sky == "plain":
        sources = _sources(source_rng, side, density, faintest, clustering, stars)
        return _plain(surveys, grids, sources, rngs, psf_variation, bad_columns, center_deg)
    counts = {"density": density, "faintest": faintest, "clustering": clustering, "stars": stars}
    sources = sky_sources(sky, source_rng, side, n_large=n_large, **counts)
    images = {"psf_variation": psf_variation, "bad_columns": bad_columns, "center_deg": center_deg}
    return painted_field(sources, grids, surveys, rngs, spoilers_of(sky, spoilers), **images)


def _defaults(sky, spoilers, n_large, density, stars):
    """Density and stars with the values of a plain sky; raise ValueError for another sky's."""
    if sky not in SKIES:
        raise ValueError(f"sky is {sky!r}, must be one of {', '.join(SKIES)}")
    if n_large < 0 or (n_large and sky != "real"):
        raise ValueError(f'n_large is {n_large}, must be 0 or more: pass it with sky="real"')
    if sky != "plain":
        return density, stars
    if spoilers is not None:
        raise ValueError('spoilers change nothing of a plain sky: pass sky="real" or "bright"')
    return 36.0 if density is None else density, 0.05 if stars is None else stars


def _grids(surveys, n_pixels, angle_deg):
    """Flat grids of both surveys; the second holds the sky of the first."""
    euclid, rubin = surveys
    turns = np.radians(angle_deg)
    reach = abs(np.cos(turns)) + abs(np.sin(turns))
    n_rubin = int(np.ceil(n_pixels * euclid.pixel_scale_arcsec * reach / rubin.pixel_scale_arcsec))
    return euclid.grid(n_pixels), rubin.grid(n_rubin, angle_deg=angle_deg)


def _plain(surveys, grids, sources, rngs, psf_variation, bad_columns, center_deg):
    """The SimulatedField of parametric galaxies."""
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
    """Raises ValueError for invalid arguments of `simulate_field`."""
    for name, value, good, wanted in (
        ("n_pixels", n_pixels, n_pixels >= 32, "32 or more"),
        ("density", density, density is None or density > 0, "above 0"),
        ("faintest", faintest, faintest > BRIGHTEST, f"above {BRIGHTEST}"),
        ("clustering", clustering, 0 <= clustering <= 1, "from 0 to 1"),
        ("stars", stars, stars is None or 0 <= stars <= 1, "from 0 to 1"),
        ("psf_variation", psf_variation, 0 <= psf_variation < 1, "from 0 to below 1"),
        ("bad_columns", bad_columns, bad_columns >= 0, "0 or more"),
    ):
        if not good:
            raise ValueError(f"{name} is {value}, must be {wanted}")
    unknown = [band for band in rubin_bands if band not in RUBIN_UGRIZY.bands]
    if unknown or not rubin_bands:
        raise ValueError(
            f"rubin_bands is {','.join(rubin_bands)!r}, must be some of "
            f"{','.join(RUBIN_UGRIZY.bands)}"
        )


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
    data[:, bad] = 1e6  # values of dead columns
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
    """Draws a source, adds it to the mosaic and returns its squared signal to noise."""
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
