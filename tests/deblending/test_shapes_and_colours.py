"""Galaxies whose shape or colours one assumption held back: disks in rows, red bulges in disks."""

import galsim
import numpy as np
import pytest

from clresample.deblending.batch import deblend
from clresample.deblending.start import profile_fit
from clresample.measurement.catalogue import catalogue
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SCALE = 0.1  # [arcsec] of the sharp image's pixels
FLUX, DEGREES = 2e4, 25 * galsim.degrees


def image(shape, scale, psf, galaxies):
    """Gaussians (y, x [arcsec], flux, sigma_y, sigma_x [arcsec]) under a PSF of sigma [arcsec]."""
    y, x = (np.indices(shape) - np.reshape(np.array(shape) - 1, (2, 1, 1)) / 2) * scale
    out = np.zeros(shape)
    for y0, x0, flux, *sigmas in galaxies:
        sy, sx = np.hypot(sigmas, psf)
        peak = flux * scale**2 / (2 * np.pi * sy * sx)
        out += peak * np.exp(-0.5 * ((y - y0) ** 2 / sy**2 + (x - x0) ** 2 / sx**2))
    return out


def observed(bands, shape, scale, psf, seed, name):
    """An Observation of {band: galaxies} with noise 1."""
    data = np.array([image(shape, scale, psf, own) for own in bands.values()])
    data += np.random.default_rng(seed).normal(size=data.shape)
    psf = PSF.gaussian(psf / scale, pixel=False, n_bands=len(bands), n_pixels=31)
    grid = Grid.flat(shape, scale)
    return Observation(data, psf, grid, weights=1.0, channels=list(bands), name=name)


def fitted(observations, places, device):
    sources = [ExtendedSource(sky_deg=place) for place in places]
    result = deblend(observations, sources, frame=model_frame(observations), device=device)
    table = catalogue(result)
    flux, error = (
        np.array([table[f"{name}_{c}"].value for c in result.channels])
        for name in ("flux", "flux_err")
    )
    return result, flux, error


def row(flux, device):
    """A flat disk between two round, red galaxies on its major axis, of a flux."""
    at, size = 0.8, ((0.2, 0.2), (0.2, 0.6), (0.2, 0.2))
    red, galaxies = {"g": 0.3, "r": 1.0}, {}
    for band, part in red.items():
        light = zip((-at, 0, at), (part * flux, 8000.0, part * flux), size, strict=True)
        galaxies[band] = [(0, x, f, *s) for x, f, s in light]
    o = observed(galaxies, (80, 80), SCALE, 0.12, 0, "sharp")
    _, found, error = fitted([o], [(0, -at), (0, 0), (0, at)], device)
    want = np.array([[f for _, _, f, *_ in own] for own in galaxies.values()])
    return (found - want) / error, (found / want)[:, 1]


@pytest.mark.parametrize(("flux", "part"), [(800.0, 0.9), (8000.0, 0.9), (32000.0, 0.5)])
def test_a_disk_between_two_galaxies_on_its_axis_keeps_its_light(device, flux, part):
    """Or its errors hold what these may have of it."""
    pull, ratio = row(flux, device)
    assert (np.abs(pull) < 3).all() and (ratio > part).all()


def test_without_another_start_its_neighbours_would_have_it(device, monkeypatch):
    monkeypatch.setattr(profile_fit, "run_without_doubt", lambda *_: None)
    pull, ratio = row(32000.0, device)
    assert (ratio < 0.75).all() and pull[0, 1] < -4


def bulge_and_disk(seed, device, gradient=True):
    """A red bulge in a blue disk, at signal to noise 200, of which a sharp image has one band."""
    rng = np.random.default_rng(seed)
    slopes = (0.7, 3.0) if gradient else (1.4, 1.4)
    parts = [
        (0.7, slopes[0], galsim.Exponential(half_light_radius=0.8).shear(q=0.6, beta=DEGREES)),
        (0.3, slopes[1], galsim.Sersic(2.5, half_light_radius=0.24).shear(q=0.8, beta=DEGREES)),
    ]
    flux = [0.0] * 4
    observations = []
    for name, bands, fwhm, n, scale, noise in (
        ("sharp", {"v": 0.7}, 0.14, 100, 0.1, 10.0),
        ("deep", {"g": 0.48, "r": 0.62, "i": 0.75}, 0.68, 50, 0.2, 20.0),
    ):
        seen = galsim.Moffat(beta=4, fwhm=fwhm)
        data = noise * rng.normal(size=(len(bands), n, n))
        for image, (band, wavelength) in zip(data, bands.items(), strict=True):
            light = [f * (wavelength / 0.62) ** slope for f, slope, _ in parts]
            whole = galsim.Sum([a * p for a, (*_, p) in zip(light, parts, strict=True)])
            whole = FLUX * galsim.Convolve(whole, seen)
            image += whole.drawImage(nx=n, ny=n, scale=scale).array
            flux["vgri".index(band)] = whole.flux
        psf = galsim.Convolve(seen, galsim.Pixel(scale))
        psf = psf.drawImage(nx=93, ny=93, scale=scale / 3, method="no_pixel").array
        psf = PSF(np.array([psf] * len(bands)), spacing=1 / 3)
        grid = Grid.flat((n, n), scale)
        o = Observation(data, psf, grid, variance=noise**2, channels=list(bands), name=name)
        observations.append(o)
    result, found, error = fitted(observations, [(0.0, 0.0)], device)
    return len(result.components), (found[:, 0] - flux) / error[:, 0]


@pytest.mark.parametrize("seed", range(2))
def test_colours_of_a_bulge_in_a_disk_are_right(device, seed):
    n, pull = bulge_and_disk(seed, device)
    assert n == 2 and (np.abs(pull) < 3).all()


def test_a_galaxy_of_one_colour_keeps_one_component(device):
    n, pull = bulge_and_disk(0, device, gradient=False)
    assert n == 1 and (np.abs(pull) < 3).all()
