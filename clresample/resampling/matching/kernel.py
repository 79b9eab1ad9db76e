"""Propagates noise through an operator: variances of pixels and their correlation.

With the kernel h of an operator, I2(X) = sum_x h(X - x) I1(x), and white noise of variance
sigma^2(x) in the input,

    var(X) = sum_x h(X - x)^2 sigma^2(x),     rho(d) = sum_X h(X) h(X + d) / sum_X h(X)^2.

h is sampled finely enough along the output's axes to resolve h^2. The variances are the result of a
second operator, whose PSF is h^2. For correlated input noise, h is first convolved with the filter
that makes such noise from white noise.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from ...sky.correlation import MAX_LAG_PX, NoiseCorrelation
from ...sky.grid import Grid
from ...sky.psf import PSF
from ...sky.psf_checks import PSFWarning
from ..resampler import Resampler
from ..tiled.resampler import TiledResampler
from .target import local_matrix

# Radius of the sampled kernel, in FWHM of the wider PSF, and its minimum [px]. Beyond it lies only
# ringing from the band's edge, under 1e-4 of the kernel's power.
REACH_FWHM, MIN_REACH_PX = 4.0, 8
# Noise with correlations below this at all lags is treated as white.
WHITE = 1e-3


class NoiseKernel:
    """The kernel of one band of an operator, for noise.

    grid_in, psf_in, grid_out, psf_out: of the operator, PSFs of one band
    noise: NoiseCorrelation of the input, or None where it is white
    device: see `get_device`

    correlation: NoiseCorrelation of the output, or None where it is white
    gain [1]: variance of the output for a variance of 1 all over the input
    """

    def __init__(self, grid_in, psf_in, grid_out, psf_out, *, noise=None, device=None):
        self.grids, self.device = (grid_in, grid_out), device
        matrix = local_matrix(grid_out, grid_in)
        self.finer = math.ceil(2 / min(psf_out.spacing, 1))
        h = self._sampled(matrix, psf_in, psf_out, noise)
        self.gain = float((h**2).sum() / self.finer**2 * abs(np.linalg.det(matrix)))
        self._scale = float((h**2).sum() / self.finer**2)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)
            self._psf = PSF(h**2, spacing=1 / self.finer)
        self.correlation = _correlation(h, self.finer)

    def _sampled(self, matrix, psf_in, psf_out, noise):
        """h (m, m) at steps of 1 / finer [output px] about its middle."""
        scale = math.sqrt(abs(np.linalg.det(matrix)))
        wide = max(float(psf_in.fwhm_px.max()), float(psf_out.fwhm_px.max()) * scale)
        reach = max(MIN_REACH_PX, REACH_FWHM * wide, MAX_LAG_PX * scale)
        n = 2 * math.ceil(math.sqrt(2) * reach) + 1
        m = 2 * math.ceil(self.finer * reach / scale) + 1
        source = np.zeros((1, n, n))
        if noise is None:
            source[0, n // 2, n // 2] = 1
        else:
            taps = noise.colouring_filter()
            half = min(len(taps) // 2, n // 2)
            middle = len(taps) // 2
            part = taps[middle - half : middle + half + 1, middle - half : middle + half + 1]
            source[0, n // 2 - half : n // 2 + half + 1, n // 2 - half : n // 2 + half + 1] = part
        fine = matrix / self.finer
        grids = [
            Grid.from_jacobian((size, size), jacobian, -jacobian @ np.full(2, size // 2))
            for size, jacobian in ((n, np.eye(2)), (m, fine))
        ]
        spaced = PSF.restore(
            psf_out.images, spacing=psf_out.spacing * self.finer, center=psf_out.center
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)  # the images' own operator has warned
            op = Resampler(grids[0], psf_in, grids[1], spaced, device=self.device)
        return op(source.astype(np.float32))[0].astype(np.float64) * self.finer**2

    def variance(self, variances) -> np.ndarray:
        """Variances (..., My, Mx) of the output for those of the input (n, Ny, Nx)."""
        variances = np.asarray(variances, np.float32)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)
            op = TiledResampler(
                self.grids[0],
                PSF(np.ones((1, 1))),
                self.grids[1],
                self._psf,
                device=self.device,
                progress=False,
            )
        return self._scale * op(variances[:, None])[:, 0].astype(np.float64)


def _correlation(h, finer):
    """NoiseCorrelation of white noise convolved with h, sampled finer; None if white."""
    size = [2 * n for n in h.shape]
    found = np.fft.irfft2(np.abs(np.fft.rfft2(h, size)) ** 2, size)
    lags = finer * np.arange(-MAX_LAG_PX, MAX_LAG_PX + 1)
    rho = found[np.ix_(lags, lags)] / found[0, 0]
    off = rho.copy()
    off[MAX_LAG_PX, MAX_LAG_PX] = 0
    return None if np.abs(off).max() < WHITE else NoiseCorrelation(rho)
