"""Scenes of bench.ladder as images: sources under PSF and pixel, sky noise, and the truth.

Two kinds of images (MODES): one survey of three bands under a Moffat PSF, or Euclid and Rubin on
the same sky. GalSim draws every source alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from clresample import PSF, ExtendedSource, Grid, Observation
from clresample.simulation.galaxies import draw, import_galsim
from clresample.simulation.scenes import RUBIN_WAVELENGTHS_NM
from clresample.simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY

MODES = ("one", "joint")
SIDE_RE, MIN_SIDE_PX = 8.0, 65  # frame's side in half-light radii and in pixels, at least
MARGIN_PX = 16.0  # [px] from the outermost source's centre to the frame's edge, at least
# One survey: 0.2 arcsec pixels, a Moffat PSF 4.2 pixels wide, 5e-5 of it beyond its image
SCALE_ARCSEC, FWHM_PX, BETA, PSF_PX = 0.2, 4.2, 3.5, 65
BANDS = ("g", "r", "i")
WAVELENGTHS_NM = {"VIS": 720.0, **dict(zip("ugrizy", RUBIN_WAVELENGTHS_NM, strict=True))}


@dataclass(frozen=True)
class Instrument:
    """An image's pixels and PSFs. psfs: GalSim profiles without the pixel; noise [counts] (C,)."""

    name: str
    scale_arcsec: float
    bands: tuple
    psfs: tuple
    images: PSF
    noise: np.ndarray
    zero_points: np.ndarray

    def grid(self, side_arcsec):
        n = int(side_arcsec / self.scale_arcsec + 1e-6)
        return Grid.flat((n, n), self.scale_arcsec)

    def light(self, galaxy, grid, position_arcsec):
        """Images (C, Ny, Nx) of a galaxy of unit flux; equal PSFs are drawn once."""
        convolve, drawn = import_galsim().Convolve, {}
        for psf in self.psfs:
            if psf not in drawn:
                drawn[psf] = draw(convolve(galaxy, psf), grid, position_arcsec=position_arcsec)
        return np.array([drawn[psf] for psf in self.psfs])

    def counts(self, index):
        """Counts (C,) of a source of magnitude 24 in r, its spectrum a power law of wavelength."""
        ratio = np.array([WAVELENGTHS_NM[band] for band in self.bands]) / WAVELENGTHS_NM["r"]
        return 10 ** (0.4 * (self.zero_points - 24)) * ratio**index


@dataclass(frozen=True)
class Part:
    """A source's light of one spectrum. share: of its light in r; profile: GalSim, unit flux."""

    profile: object
    index: float
    share: float = 1.0


@dataclass(frozen=True)
class Item:
    """A source of a scene; n, re_px, q are those of its profile, NaN where it has none."""

    parts: tuple
    snr: float
    n: float = np.nan
    re_px: float = np.nan
    q: float = np.nan
    away_px: tuple = (0.0, 0.0)
    role: str = "galaxy"
    fitted_as: type = ExtendedSource


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of a fit, and the truth.

    inside, total (S, C) [counts]: flux of each source inside the image and of all of it
    """

    observations: tuple
    sources: tuple
    items: tuple
    inside: np.ndarray
    total: np.ndarray


@cache
def instruments(mode):
    """Instruments of one of MODES, the finest first."""
    galsim = import_galsim()
    if mode == "one":
        moffat = galsim.Moffat(BETA, fwhm=FWHM_PX * SCALE_ARCSEC)
        image = draw(moffat, Grid.flat((PSF_PX, PSF_PX), SCALE_ARCSEC))
        psfs, images = (moffat,) * len(BANDS), PSF(np.array([image] * len(BANDS)))
        n = len(BANDS)
        return (Instrument("one", SCALE_ARCSEC, BANDS, psfs, images, np.ones(n), np.full(n, 27.0)),)
    return tuple(
        Instrument(
            survey.name,
            survey.pixel_scale_arcsec,
            survey.bands,
            tuple(galsim.Gaussian(sigma=sigma) for sigma in survey.psf_sigma_arcsec),
            survey.psf(),
            survey.noise_sigma,
            survey.zero_points_mag,
        )
        for survey in (EUCLID_VIS, RUBIN_UGRIZY)
    )


def make_scene(mode, items, rng):
    """Draws a scene of Items, the first of them within half a pixel of the frame's middle."""
    finest = instruments(mode)[0]
    scale, side_px = finest.scale_arcsec, _side_px(items)
    middle = rng.uniform(-0.5, 0.5, 2)
    places = [scale * (middle + item.away_px) for item in items]
    views = [(one, one.grid(side_px * scale)) for one in instruments(mode)]
    drawn = [_draw(item, views, place) for item, place in zip(items, places, strict=True)]
    observations = []
    for i, (one, grid) in enumerate(views):
        noise = one.noise[:, None, None]
        light = sum(images[i] for images, _ in drawn)
        observations.append(
            Observation(
                light + noise * rng.standard_normal(light.shape),
                one.images,
                grid,
                variance=one.noise**2,
                channels=one.bands,
                zero_points=one.zero_points,
                name=one.name,
            )
        )
    inside = [np.concatenate([i.sum(axis=(1, 2)) for i in images]) for images, _ in drawn]
    total = np.array([total for _, total in drawn])
    sources = tuple(
        item.fitted_as(sky_deg=tuple(map(float, place)))
        for item, place in zip(items, places, strict=True)
    )
    return Scene(tuple(observations), sources, tuple(items), np.array(inside), total)


def _side_px(items):
    """Side of the frame [px of the finest instrument], an odd number."""
    by_size = [SIDE_RE * item.re_px for item in items if item.re_px > 0]
    by_place = [2 * (np.abs(item.away_px).max() + MARGIN_PX) for item in items]
    return int(np.ceil(max(MIN_SIDE_PX, *by_size, *by_place))) | 1


def _draw(item, views, place):
    """Images of a source, one (C, Ny, Nx) for each view, and all its counts (all channels)."""
    images = [
        sum(
            part.share
            * one.counts(part.index)[:, None, None]
            * one.light(part.profile, grid, place)
            for part in item.parts
        )
        for one, grid in views
    ]
    counts = [sum(part.share * one.counts(part.index) for part in item.parts) for one, _ in views]
    in_sigma = [
        (image / one.noise[:, None, None]).ravel()
        for image, (one, _) in zip(images, views, strict=True)
    ]
    factor = item.snr / np.linalg.norm(np.concatenate(in_sigma))
    return [factor * image for image in images], factor * np.concatenate(counts)
