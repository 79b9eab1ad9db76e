"""Scenes whose PSF varies from source to source."""

import numpy as np

from clresample import PSF, FunctionPSF, Grid, Observation

SHAPE = 72, 96
# Light of the bands of `stars` and what a pixel's noise is of it.
FLUXES, NOISE = np.array([[4e3, 7e3], [6e3, 3e3], [2e3, 5e3], [5e3, 4e3]]), 1.0


def widening(y, x):
    """Two bands that widen along x, and one of them along y: by a quarter over 96 pixels."""
    return PSF.gaussian([1.5 + 0.004 * x, 1.6 + 0.002 * x + 0.003 * y], n_pixels=33)


def stamp(psf, band, place, shape):
    """A star at place (y, x) of an image: the PSF's samples moved by their Fourier series.

    All of its light is on the stamp.
    """
    n_y, n_x = psf.images.shape[1:]
    image, corner = np.zeros(shape), np.floor(np.array(place) - psf.center[band] + 0.5).astype(int)
    nu_y, nu_x = np.fft.fftfreq(n_y)[:, None], np.fft.fftfreq(n_x)
    dy, dx = np.array(place) - psf.center[band] - corner
    wave = np.fft.fft2(psf.images[band]) * np.exp(-2j * np.pi * (nu_y * dy + nu_x * dx))
    moved = np.fft.ifft2(wave).real
    low, high = np.maximum(corner, 0), np.minimum(corner + (n_y, n_x), shape)
    image[low[0] : high[0], low[1] : high[1]] = moved[
        low[0] - corner[0] : high[0] - corner[0], low[1] - corner[1] : high[1] - corner[1]
    ]
    return image


def stars(places, seed=0, *, fluxes=FLUXES, noise=NOISE):
    """An observation of two bands with a star at each place (S, 2) [px], each with its own PSF."""
    rng, data = np.random.default_rng(seed), np.zeros((2, *SHAPE))
    for place, flux in zip(places, fluxes, strict=True):
        psf = widening(*place)
        for band in (0, 1):
            data[band] += flux[band] * stamp(psf, band, place, SHAPE)
    return data + noise * rng.normal(size=data.shape)


def observation(data, psf=None, channels=("g", "r"), **given):
    """`data` as an Observation whose PSF varies as `widening`, or has that PSF."""
    psf = FunctionPSF(widening, 2) if psf is None else psf
    grid = Grid.flat(data.shape[1:], 0.2)
    return Observation(data, psf, grid, variance=NOISE**2, channels=channels, **given)
