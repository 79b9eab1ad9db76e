"""Maps any images onto one grid and one PSF, with their noise there: `match`."""

from __future__ import annotations

import warnings

import numpy as np

from ...device.multi_device import one_blas_thread
from ...sky.correlation import NoiseCorrelation
from ...sky.grid import Grid
from ...sky.observation import Observation, check_observations
from ...sky.psf import PSF
from ...sky.psf_checks import PSFWarning
from ...sky.validation.checks import check_instance, check_sequence
from ..plan import is_identity
from ..tiled.resampler import TiledResampler
from .kernel import NoiseKernel
from .target import psf_on, widest

# Largest fraction of a pixel's noise power from pixels without weight or outside the image. Pixels
# above it get weight 0. The tails of a kernel add up to some 1e-3.
MAX_LOST = 1e-2
# [px] Width of the Gaussian that fills pixels without weight from those about them.
FILL_SIGMA_PX = 1.5


@one_blas_thread()
def match(observations, grid=None, psf=None, *, max_gain=2.0, device=None) -> Observation:
    """Maps images of several instruments onto one grid and one PSF, as one Observation.

    Each channel is mapped by the operator of the fits: resampled and convolved exactly, in one
    step, to the flux per pixel of the new pixels. The noise is propagated: the variance of every
    pixel, and the correlation of neighbouring pixels.

    observations: one or several Observations of one patch of sky
    grid: Grid of the result; None = that of the observation with the widest PSF
    psf: PSF of the result in pixels of `grid`, of one band; None = the widest of all, in arcsec
    max_gain [1]: largest permitted gain of the noise at any frequency; it exceeds 1 if a PSF wider
        than `psf` is sharpened
    device: see `get_device`

    returns Observation: all channels (C, Ny, Nx) in the order passed, each in its own counts, with
        its weights, names, zero points and NoiseCorrelation. Pixels without weight are filled from
        their neighbours. Weights are 0 beyond an image's edge, and where over a hundredth of a
        pixel's noise comes from filled pixels. A PSF that varies is evaluated in the middle of its
        image

    Raises ValueError for incompatible observations, a grid that none of them overlaps,
    a PSF of several bands, and a gain over max_gain.
    """
    if isinstance(observations, Observation):
        observations = (observations,)
    observations = check_sequence("observations", observations)
    check_observations(observations)
    like, band = widest(observations)
    if grid is None:
        grid = observations[like].grid
    check_instance("grid", grid, Grid)
    if psf is None:
        own = observations[like].psf[band]
        psf = own if grid is observations[like].grid else psf_on(own, observations[like].grid, grid)
    check_instance("psf", psf, PSF)
    if psf.n_bands != 1:
        raise ValueError(f"psf has {psf.n_bands} bands, must have one: choose with psf[band]")
    parts = [_matched(o, grid, psf, max_gain, device) for o in observations]
    data, weights, noise = (
        [image for part in parts for image in part[k]] for k in range(3)
    )  # fmt: skip
    white = all(n is None for n in noise)
    zero_points = [o.zero_points for o in observations]
    return Observation(
        np.array(data),
        psf,
        grid,
        weights=np.array(weights),
        channels=tuple(c for o in observations for c in o.channels),
        bands=tuple(b for o in observations for b in o.bands),
        zero_points=None if zero_points[0] is None else np.concatenate(zero_points),
        noise=None if white else [n or NoiseCorrelation(np.ones((1, 1))) for n in noise],
        name="matched",
    )


def _matched(observation, grid, psf, max_gain, device):
    """Images, weights and correlations of an observation's channels, a list each."""
    o, mapping = observation, grid.map_to(observation.grid)
    noise = [None] * len(o.data) if o.noise is None else list(o.noise)
    noise = [None if n is None or n.autocorrelation.size == 1 else n for n in noise]
    data, weights = np.zeros((2, len(o.data), *grid.shape))
    same = [grid.shape == o.grid.shape and is_identity(mapping, o.psf[c], psf)
            for c in range(len(o.data))]  # fmt: skip
    for c in np.flatnonzero(same):
        data[c], weights[c] = o.data[c], o.weights[c]
    rest = [int(c) for c in np.flatnonzero(np.logical_not(same))]
    if not rest:
        return data, weights, noise
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)  # an error is raised below if it matters
        op = TiledResampler(o.grid, o.psf[rest], grid, psf, device=device, progress=False)
    gains = op.certificate.max_gain
    if gains.max() > max_gain:
        worst = int(gains.argmax())
        raise ValueError(
            f"psf would sharpen channel {o.channels[rest[worst]]!r} and raise its noise up to "
            f"{gains[worst]:.3g} times, max_gain is {max_gain:g}: give a wider psf, or a larger "
            "max_gain"
        )
    good = o.weights[rest] > 0
    filled = [_filled(image, seen) for image, seen in zip(o.data[rest], good, strict=True)]
    data[rest] = op(np.array(filled, np.float32))
    covered = op.covered
    for c, seen in zip(rest, good, strict=True):
        kernel = NoiseKernel(o.grid, o.psf[c], grid, psf, noise=noise[c], device=device)
        usual = 1 / np.median(o.weights[c][seen]) if seen.any() else 1.0
        variance = np.divide(1.0, o.weights[c], out=np.full(seen.shape, usual), where=seen)
        found, held = kernel.variance(np.stack([variance / usual, seen.astype(float)]))
        kept = covered & (held > (1 - MAX_LOST) * kernel.gain) & (found > 0)
        np.divide(1 / usual, found, out=weights[c], where=kept)
        noise[c] = kernel.correlation
    return data, weights, noise


def _filled(image, seen):
    """Fills the pixels of an image (Ny, Nx) without weight from their neighbours."""
    if seen.all():
        return image
    from astropy.convolution import Gaussian2DKernel, interpolate_replace_nans

    holed = np.where(seen, image, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what stays NaN, far from any good pixel: 0 below
        return np.nan_to_num(interpolate_replace_nans(holed, Gaussian2DKernel(FILL_SIGMA_PX)))
