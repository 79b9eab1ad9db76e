"""Standard workloads to time devices: renders of stamps, and joint fits of small blends.

Needs no data and no GalSim: galaxies are exponential discs, PSFs Gaussians.
"""

from __future__ import annotations

import copy
import warnings

import numpy as np

from ...deblending.batch import deblend_many
from ...deblending.blend import Blend
from ...deblending.ended import Ended
from ...deblending.fit import Fit, start_fits
from ...deblending.inspection.inspect import InputWarning
from ...deblending.iterate import iterate
from ...deblending.settings import Settings
from ...device.discovery import DeviceError
from ...device.tuning import Tuning
from ...resampling.resampler import Resampler
from ...sky.grid import Grid
from ...sky.observation import Observation
from ...sky.psf import PSF
from ...sky.sources import ExtendedSource, SourceWarning
from .measure import best_seconds

EUCLID_ARCSEC, RUBIN_ARCSEC = 0.1, 0.2
STAMP_PX, BATCH = 100, 64
BLEND_PX, N_SOURCES, N_ITERATIONS = 48, 3, 10
N_SET_UP = 4  # different fits; copies of them give larger numbers
SIGMA = 1e-3  # [peak of a galaxy] noise of the blends


class RenderWorkload:
    """Stamps of 100 x 100 Euclid pixels rendered in one band of Rubin, 64 in a call."""

    def __init__(self, device, dtype=np.float32):
        euclid = Grid.flat((STAMP_PX, STAMP_PX), EUCLID_ARCSEC)
        rubin = Grid.flat((STAMP_PX // 2, STAMP_PX // 2), RUBIN_ARCSEC)
        self.op = Resampler(
            euclid, PSF.gaussian(0.8), rubin, PSF.gaussian(1.5), device=device, dtype=dtype
        )
        stamps = np.random.default_rng(0).standard_normal((BATCH, *self.op.shape_in))
        self.device, self.x = device, device.put(stamps, dtype)
        self.y = device.empty((BATCH, *self.op.shape_out), dtype)

    def __call__(self):
        """Renders all stamps once and waits for the device."""
        self.op(self.x, out=self.y)
        self.device.finish()

    def rate(self, seconds=0.5):
        """Renders in a second."""
        return BATCH / best_seconds(self, seconds)


def blends(n, device):
    """Blends of three galaxies each, in one Euclid band and three of Rubin."""
    rng = np.random.default_rng(1)
    half = BLEND_PX // 2
    euclid, rubin = (
        Grid.flat((size, size), arcsec)
        for size, arcsec in ((BLEND_PX, EUCLID_ARCSEC), (half, RUBIN_ARCSEC))
    )
    psfs = PSF.gaussian(0.8), PSF.gaussian([1.6, 1.5, 1.4])
    ops = [
        Resampler(euclid, PSF.gaussian(0.8), grid, psf, device=device)
        for grid, psf in zip((euclid, rubin), psfs)
    ]
    y, x = np.indices(euclid.shape)
    made = []
    for _ in range(n):
        places = rng.uniform(0.3 * BLEND_PX, 0.7 * BLEND_PX, (N_SOURCES, 2))
        discs = np.stack([np.exp(-np.hypot(y - a, x - b) / 3) for a, b in places])
        observations = []
        for op, grid, psf in zip(ops, (euclid, rubin), psfs):
            fluxes = rng.uniform(0.3, 1, (psf.n_bands, N_SOURCES))
            data = op(np.tensordot(fluxes, discs, 1).astype(np.float32)).astype(float)
            data += SIGMA * rng.standard_normal(data.shape)
            weights = np.full(data.shape, SIGMA**-2)
            names = [f"{grid.shape[0]} px {band}" for band in range(psf.n_bands)]
            observations.append(Observation(data, psf, grid, weights=weights, channels=names))
        sources = tuple(ExtendedSource(position_px=tuple(place)) for place in places)
        made.append(Blend(tuple(observations), sources))
    return made


def fit(given, device, **settings):
    """Results of blends, fitted side by side, without warnings about sources and images."""
    with warnings.catch_warnings():
        for kind in (SourceWarning, InputWarning):
            warnings.simplefilter("ignore", kind)
        results = deblend_many(given, settings=Settings(**settings), device=device, processes=1)
    for result in results:
        if result.status == Ended.FAILED:
            raise DeviceError(f"{device.name}: a fit that should succeed failed: {result.reason}")
    return results


def iterate_once(blend, device):
    """Starts a fit of the blend and iterates a little, so that all its kernels are built."""
    settings = Settings(max_iter=1)
    fits = [Fit(blend, settings, device, np.float32, pad=1)]
    start_fits(fits)
    iterate(fits, settings, device, np.float32)


class FitWorkload:
    """The iterations of `n` fits, set up once, with Tuning's number of them side by side."""

    def __init__(self, device, n):
        self.device, self.settings = device, Settings(max_iter=N_ITERATIONS)
        self.fits = [
            Fit(blend, self.settings, device, np.float32, pad=1)
            for blend in blends(N_SET_UP, device)
        ]
        start_fits(self.fits)
        self.n = n

    def __call__(self):
        """Iterates all fits once, from their start."""
        n_most = Tuning.of(self.device).n_scenes
        fits = [copy.copy(self.fits[i % len(self.fits)]) for i in range(self.n)]
        for fit in fits:
            fit.losses = []
        for start in range(0, self.n, n_most):
            iterate(fits[start : start + n_most], self.settings, self.device, np.float32)
