"""Scenes of bench.spoilt, before anything is made wrong in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from clresample import PSF, ExtendedSource, Grid, Observation, Settings, detect
from clresample.simulation.galaxies import import_galsim
from clresample.simulation.scenes import simulate_scene
from clresample.sky.noise import background

PLACE_DEG = (150.0, 2.0)  # where scenes of a flat sky are put, so that all have a WCS
HSC_SCALE_ARCSEC, HSC_ZERO_POINT = 0.168, 27.0
SIM_SEED, SIM_SOURCES = 3, 5
# An Airy PSF as Roman's at 1.58 um, aliased in samples of a pixel and not in those of 0.25 pixels
ROMAN_ARCSEC, ROMAN_SPACING, ROMAN_PX, ROMAN_SIDE = 0.11, 0.25, 51, 91
AIRY = {"lam": 1577.0, "diam": 2.36, "obscuration": 0.32}  # nm, m, part of the diameter
ROMAN_SNR, ROMAN_SIZE_ARCSEC = (300.0, 150.0, 80.0), (0.15, 0.2, 0.1)

# Words of warnings that are true of scenes as they are. hsc_blend: its catalogue lacks a source,
# with which chi2 is lower by 318 in five bands; `sep` finds it too. hsc_cutout: where HST's image
# of the same sky is darkest, a tenth of the pixels, the level is -0.31 to -0.36 +- 0.05 sigma in
# each band, since the background of crowded images is too high. HSC's coadds are resampled.
CORRELATED = "noise of neighbouring pixels is correlated"
TRUE_OF = {
    "hsc_blend": ("no source is listed for", CORRELATED),
    "hsc_cutout": ("too much sky was subtracted", CORRELATED),
}


@dataclass(frozen=True, eq=False)
class Scene:
    """Observations, places of the sources (S, 2) [deg], the original number of each, settings."""

    observations: tuple
    places: np.ndarray
    owners: np.ndarray
    settings: Settings

    def sources(self):
        return [ExtendedSource(sky_deg=tuple(map(float, place))) for place in self.places]


def has_doubles(scene):
    """Returns True if two sources lie within a pixel of the scene's sharpest image."""
    grid = min((o.grid for o in scene.observations), key=lambda grid: grid.pixel_scale_arcsec)
    places = grid.pixel(*scene.places.T)
    apart = np.hypot(*(places[:, None] - places).T)
    return bool((apart[np.triu_indices(len(apart), 1)] < 1).any())


def scene_of(observations, places):
    return Scene(tuple(observations), places, np.arange(len(places)), Settings())


def hsc_blend(data):
    """The HSC blend with the sources of its catalogue."""
    with np.load(data / "hsc_cosmos_blend.npz") as file:
        shape = file["images"].shape[1:]
        grid = Grid.flat(shape, HSC_SCALE_ARCSEC).to_wcs(ra_deg=PLACE_DEG[0], dec_deg=PLACE_DEG[1])
        grid = Grid.from_wcs(grid, shape)
        observation = Observation(
            file["images"],
            PSF(file["psfs"]),
            grid,
            variance=file["variance"],
            channels=[str(name) for name in file["filters"]],
            zero_points=HSC_ZERO_POINT,
            name="HSC",
        )
        x, y = file["catalog"]["x"], file["catalog"]["y"]
    return scene_of([observation], grid.sky(np.asarray(y, float), np.asarray(x, float)).T)


def hsc_cutout(data):
    """HSC's images of the HST + HSC pair, with sources detected.

    Too much sky was subtracted from the files, and is added here.
    """
    folder = data / "hst_hsc"
    images, header = fits.getdata(folder / "hsc_grizy.fits", header=True)
    found = np.array([background(image) for image in images])
    observation = Observation(
        images - found[:, 0, None, None],
        PSF(fits.getdata(folder / "psf_hsc_grizy.fits")),
        Grid.from_wcs(WCS(header).celestial, images.shape[1:]),
        variance=found[:, 1] ** 2,
        channels=list("grizy"),
        zero_points=HSC_ZERO_POINT,
        name="HSC",
    )
    detection = detect([observation])
    frame = detection.frame
    places = np.array([frame.grid.sky(*source.pixel(frame.grid)) for source in detection.sources])
    return scene_of([observation], places)


def simulated(seed, n_sources=None):
    """Euclid and Rubin by `simulate_scene`."""
    scene = simulate_scene(seed, n_sources=n_sources, center_deg=PLACE_DEG)
    return scene_of([image.observation() for image in scene.images], scene.positions_deg)


def roman(seed=0):
    """Small galaxies under an Airy PSF, whose image has samples of a quarter of a pixel."""
    galsim, rng = import_galsim(), np.random.default_rng(seed)
    psf = galsim.Convolve(galsim.Airy(**AIRY), galsim.Pixel(ROMAN_ARCSEC))
    grid = Grid.flat((ROMAN_SIDE, ROMAN_SIDE), ROMAN_ARCSEC)
    places = rng.uniform(-2.0, 2.0, (len(ROMAN_SNR), 2))  # [arcsec]
    data = rng.standard_normal(grid.shape)
    for size, snr, (y, x) in zip(ROMAN_SIZE_ARCSEC, ROMAN_SNR, places, strict=True):
        galaxy = galsim.Convolve(galsim.Exponential(half_light_radius=size), psf).shift(x, y)
        image = _drawn(galaxy, ROMAN_SIDE, ROMAN_ARCSEC)
        data += snr / np.linalg.norm(image) * image
    on_sky = Grid.from_wcs(grid.to_wcs(ra_deg=PLACE_DEG[0], dec_deg=PLACE_DEG[1]), grid.shape)
    observation = Observation(
        data,
        PSF(_roman_psf(psf, ROMAN_SPACING), spacing=ROMAN_SPACING),
        on_sky,
        weights=1.0,
        channels=["F158"],
        zero_points=26.0,
        name="Roman",
    )
    return scene_of([observation], on_sky.sky(*grid.pixel(*places.T).T).T)


def _roman_psf(psf, spacing):
    n = int(ROMAN_PX / spacing) | 1
    return _drawn(psf, n, spacing * ROMAN_ARCSEC)


def _drawn(profile, n, scale_arcsec):
    """Samples (n, n) of a profile that holds the pixel already."""
    image = import_galsim().ImageD(n, n, scale=scale_arcsec)
    return profile.drawImage(image, method="no_pixel").array


def changed(o, **new):
    """An Observation made anew with some of its parts replaced."""
    kept = {
        "data": o.data,
        "psf": o.psf,
        "grid": o.grid,
        "weights": o.weights,
        "channels": o.channels,
        "zero_points": o.zero_points,
        "name": o.name,
    } | new
    return Observation(kept.pop("data"), kept.pop("psf"), kept.pop("grid"), **kept)
