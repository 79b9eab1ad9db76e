"""PSF values between its samples, and the sharpest contrast of light behind a PSF."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

# [px] Sub-pixel positions of a point at which the contrast of its image is evaluated: four more
# change the sharpest contrast of a PSF of 1.5 px FWHM by less than a hundredth.
PHASES = np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
# Contrast is that of a PSF narrower by this factor, so that no star's core is masked as a cosmic
# ray: PSFs are measured to a few percent, and those of other exposures or filters differ by more.
NARROWER = 1.25
N_ANGLES = 16  # of the circles over which a PSF is averaged


def psf_at(psf, band, y, x) -> np.ndarray:
    """Values (n, m) [1] of a band of a PSF at y (n,), x (m,) [px] from its centre.

    Sinc interpolation of the samples, which is exact for a band-limited PSF.
    """
    image, (y0, x0) = psf.images[band], psf.center[band]
    n_y, n_x = image.shape
    along_y = np.sinc((np.asarray(y) / psf.spacing + y0)[:, None] - np.arange(n_y))
    along_x = np.sinc((np.asarray(x) / psf.spacing + x0)[:, None] - np.arange(n_x))
    return along_y @ image @ along_x.T


def ring_mean(psf, band, radius) -> float:
    """Mean value [1] of a band of a PSF on a circle of this radius [px] about its centre."""
    angles = np.arange(N_ANGLES) * 2 * np.pi / N_ANGLES
    return float(
        np.diag(psf_at(psf, band, radius * np.sin(angles), radius * np.cos(angles))).mean()
    )


def inscribed_radius(psf, band) -> float:
    """Radius [px] of the circle about a band's centre one pixel inside the PSF's image."""
    (n_y, n_x), (y0, x0) = psf.images.shape[1:], psf.center[band]
    return float(psf.spacing * min(y0, x0, n_y - 1 - y0, n_x - 1 - x0) - 1)


@lru_cache(maxsize=32)
def pair_ratios(psf) -> np.ndarray:
    """Least sum of two opposite neighbours of a pixel, over the pixel's own value: (C, 2) [1].

        kappa_y = min_x [P(1 - x) + P(-1 - x)] / P(-x),    x: position of a point in its pixel

    Along y and along x, for the PSF made narrower by a quarter. Non-negative light convolved with
    the PSF has at least this ratio everywhere: a pixel with less is not light from the sky.
    """
    places = NARROWER * (PHASES[:, None] + [-1.0, 0.0, 1.0]).ravel()
    n = len(PHASES)
    ratios = []
    for band in range(psf.n_bands):
        values = psf_at(psf, band, places, places).reshape(n, 3, n, 3)
        middle = np.maximum(values[:, 1, :, 1], 1e-30)
        along_y = (values[:, 0, :, 1] + values[:, 2, :, 1]) / middle
        along_x = (values[:, 1, :, 0] + values[:, 1, :, 2]) / middle
        ratios.append([along_y.min(), along_x.min()])
    return np.maximum(ratios, 0.0)
