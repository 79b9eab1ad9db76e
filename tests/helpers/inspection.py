"""A small image of two galaxies and a star, and what is found before it is fitted."""

import re

import numpy as np

from clresample.deblending.blend import Blend
from clresample.deblending.inspection.image import InspectedImage
from clresample.deblending.inspection.inspect import inspect
from clresample.deblending.settings import Settings
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE, NOISE, FWHM_SIGMA = (64, 60), 2.0, 1.5
# (y, x) [px], flux [counts] in two channels, sigma [px] of the galaxy before the PSF; 0: a star
DRAWN = (((20.2, 18.7), (3000, 5000), 1.5), ((24.0, 41.3), (2500, 1500), 2.0))
DRAWN += (((47.6, 30.1), (2000, 3000), 0.0),)


def image_of(drawn=DRAWN, *, seed=0, sky=0.0, sigma=FWHM_SIGMA, shape=SHAPE, noise=NOISE):
    """Data (2, Ny, Nx) of Gaussian galaxies behind a Gaussian PSF of `sigma` [px]."""
    y, x = np.indices(shape)
    data = np.random.default_rng(seed).normal(sky, noise, (2, *shape))
    for (a, b), fluxes, size in drawn:
        s2 = size**2 + sigma**2 + 1 / 12
        light = np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * s2)) / (2 * np.pi * s2)
        data += np.array(fluxes)[:, None, None] * light
    return data


def observed(data, *, sigma=FWHM_SIGMA, name="cam", channels=("g", "r"), **given):
    grid = Grid.flat(data.shape[-2:], 0.2)
    given = {"weights": NOISE**-2} | given
    return Observation(data, PSF.gaussian(sigma), grid, name=name, channels=channels, **given)


def with_photon_noise(drawn, *, gain=0.5, seed=0, psf_sigma=FWHM_SIGMA):
    """An Observation whose noise and variance have that of the sources' light."""
    light = image_of(drawn, noise=0.0)
    variance = NOISE**2 + light / gain
    data = light + np.random.default_rng(seed).normal(size=light.shape) * variance**0.5
    return observed(data, sigma=psf_sigma, weights=1 / variance)


def stars(n, seed, shape=SHAPE, faintest=120.0, ratio=1000.0, apart=2.0):
    """Stars as in DRAWN at places at least `apart` [px] apart, of evenly distributed ln flux."""
    rng, places = np.random.default_rng(seed), []
    while len(places) < n:
        place = rng.uniform(4, np.array(shape) - 5)
        if all(np.hypot(*(place - other)) >= apart for other in places):
            places.append(place)
    fluxes = faintest * ratio ** rng.uniform(size=n)
    return tuple((tuple(p), (f, f), 0.0) for p, f in zip(places, fluxes, strict=True))


def sources_of(drawn=DRAWN, kind=ExtendedSource):
    return tuple(kind(position_px=place) for place, _, _ in drawn)


def inspected(observations, sources=None, **settings):
    blend = Blend(tuple(observations), sources or sources_of())
    frame = model_frame(blend.observations)
    shifts = np.zeros((len(blend.observations), 2))
    positions = frame.positions_of(blend.sources, blend.observations)
    found = inspect(blend, frame, positions, shifts, Settings(**settings))
    for message in found.messages:  # notes of fields consist of the first sentences
        sentence = re.split("[:(]", message.removeprefix("cam: "))[0]
        assert re.findall(r"(?<!\w)[-+]?\d", sentence.replace("within 1 model pixel", "")) == []
    return found


def looked_at(observation, sources=None):
    frame = model_frame([observation])
    return InspectedImage.of(
        observation, frame, frame.positions_of(sources or sources_of()), np.zeros(2)
    )
