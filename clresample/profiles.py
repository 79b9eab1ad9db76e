"""Smooth profiles on model pixels: what a source looks like before its own structure is fitted.

    S(x) = (1 + q / (2 beta))^(-beta - 1),   q = (x - c)^T C^-1 (x - c)
    C = sigma^2 [[1 + e1, e2], [e2, 1 - e1]] + C_psf      rows and columns (y, x)

beta -> infinity is a Gaussian, small beta has wings; C_psf is the model PSF's own second moment, so that
sigma -> 0 is a star.  Point sources are the model's PSF itself, interpolated by its band-limit.
"""

from __future__ import annotations

import numpy as np

from .psf import PSF

# Steps of the central differences in (ln sigma, g1, g2, ln beta): errors of their square, under 1e-3.
STEPS = (0.02, 0.02, 0.02, 0.05)


def covariance(parameters, psf_moment):
    """C (2, 2) [px^2] from (ln sigma [px], g1, g2, ln beta); |e| = |g| / sqrt(1 + g^2) stays under 1."""
    sigma2 = np.exp(2 * parameters[0])
    e1, e2 = np.asarray(parameters[1:3]) / np.sqrt(1 + np.dot(parameters[1:3], parameters[1:3]))
    return sigma2 * np.array([[1 + e1, e2], [e2, 1 - e1]]) + psf_moment


def profile(parameters, position, shape, psf_moment, origin=(0, 0)):
    """Profile (ny, nx) of unit integral on the pixels from `origin` on."""
    c = covariance(parameters, psf_moment)
    det = np.linalg.det(c)
    dy, dx = (np.arange(n) + o - p for n, o, p in zip(shape, origin, position, strict=True))
    dy = dy[:, None]
    q = (c[1, 1] * dy**2 - 2 * c[0, 1] * dy * dx + c[0, 0] * dx**2) / det
    beta = np.exp(parameters[3])
    return (1 + q / (2 * beta)) ** (-beta - 1) / (2 * np.pi * np.sqrt(det))


def profile_with_slopes(parameters, position, shape, psf_moment):
    """The profile and its derivatives by each parameter (5, ny, nx)."""
    images = [profile(parameters, position, shape, psf_moment)]
    for k, step in enumerate(STEPS):
        high, low = np.array(parameters), np.array(parameters)
        high[k] += step
        low[k] -= step
        images.append((profile(high, position, shape, psf_moment)
                       - profile(low, position, shape, psf_moment)) / (2 * step))
    return np.array(images)


def moment(psf: PSF) -> np.ndarray:
    """Second moment (2, 2) [px^2] of the first band's image about its centre, rows (y, x)."""
    image = psf.images[0]
    y, x = ((np.arange(n) - c) * psf.spacing for n, c in zip(image.shape, psf.center[0], strict=True))
    yy, xx, yx = (y**2) @ image.sum(1), (x**2) @ image.sum(0), y @ image @ x
    return np.array([[yy, yx], [yx, xx]])


def point(psf: PSF, position, shape):
    """The PSF at a sub-pixel position and its derivatives by (y, x) (3, ny, nx), unit integral.

        S(x) = K^-2 sum_nu P^(nu) exp(2 pi i nu.(x - c))      K > n + the PSF's own extent
    """
    extent = int(np.ceil(max(psf.images.shape[1:]) * psf.spacing))
    n_fft = max(shape) + 2 * extent + 1
    n_fft += 1 - n_fft % 2
    nu = np.arange(-(n_fft // 2), n_fft // 2 + 1) / n_fft
    spectrum = psf.spectrum(nu, nu)[0] / n_fft**2
    waves_y, waves_x = (np.exp(2j * np.pi * np.outer(np.arange(n) - p, nu))
                        for n, p in zip(shape, position, strict=True))
    slope = -2j * np.pi * nu
    return np.array([
        (waves_y @ (spectrum * by * bx) @ waves_x.T).real
        for by, bx in ((1, 1), (slope[:, None], 1), (1, slope))
    ])
