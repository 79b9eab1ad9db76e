"""Smooth profiles on model pixels: what a source looks like before its own structure is fitted.

    S(x) = (1 + q / (2 beta))^(-beta - 1),   q = (x - c)^T C^-1 (x - c)
    C = sigma^2 [[1 + e1, e2], [e2, 1 - e1]] + C_psf      rows and columns (y, x)

beta -> infinity is a Gaussian, small beta has wings; C_psf is the model PSF's own second moment, so
that sigma -> 0 is a star.  Point sources are the model's PSF itself, interpolated by its band.
"""

from __future__ import annotations

import functools

import numpy as np

from ..sky.psf import PSF

# Spectra of the model's PSF that are kept: stars of one frame share one, of 1 MB at 256 pixels.
N_SPECTRA = 8


def covariance(parameters, psf_moment):
    """C (2, 2) [px^2] and its derivatives (3, 2, 2) by (ln sigma [px], g1, g2).

    e = g / sqrt(1 + g^2), so that |e| stays under 1
    """
    log_sigma, g1, g2 = parameters[:3]
    sigma2, root = np.exp(2 * log_sigma), np.sqrt(1 + g1**2 + g2**2)
    shape = np.array([[[1, 0], [0, -1]], [[0, 1], [1, 0]]])
    e = np.array([g1, g2]) / root
    de = (np.eye(2) - np.outer(e, e)) / root  # de_i / dg_j
    own = sigma2 * (np.eye(2) + np.tensordot(e, shape, 1))
    slopes = np.array([2 * own, *(sigma2 * np.tensordot(de[:, j], shape, 1) for j in (0, 1))])
    return own + psf_moment, slopes


def profile(parameters, position, shape, psf_moment):
    """Profile of unit integral and its derivatives by (ln sigma, g1, g2, ln beta), (5, ny, nx)."""
    c, slopes = covariance(parameters, psf_moment)
    inverse, beta = np.linalg.inv(c), np.exp(parameters[3])
    dy, dx = (np.arange(n) - p for n, p in zip(shape, position, strict=True))
    dy = dy[:, None]
    u, v = (inverse[i, 0] * dy + inverse[i, 1] * dx for i in (0, 1))  # C^-1 x
    q = dy * u + dx * v
    s = np.exp(-(beta + 1) * np.log1p(q / (2 * beta))) / (2 * np.pi * np.sqrt(np.linalg.det(c)))
    fall = (beta + 1) / (2 * beta + q)  # - d ln S / dq
    out = [s]
    for dc in slopes:
        dq = -(dc[0, 0] * u**2 + 2 * dc[0, 1] * u * v + dc[1, 1] * v**2)
        out.append(-s * (fall * dq + 0.5 * np.trace(inverse @ dc)))
    out.append(s * (q * fall - beta * np.log1p(q / (2 * beta))))
    return np.array(out)


def moment(psf: PSF) -> np.ndarray:
    """Second moment (2, 2) [px^2] of the first band's image about its centre, rows (y, x)."""
    image = psf.images[0]
    y, x = (
        (np.arange(n) - c) * psf.spacing for n, c in zip(image.shape, psf.center[0], strict=True)
    )
    yy, xx, yx = (y**2) @ image.sum(1), (x**2) @ image.sum(0), y @ image @ x
    return np.array([[yy, yx], [yx, xx]])


def point(psf: PSF, position, shape, *, slopes=True):
    """The PSF at a sub-pixel position and its derivatives by (y, x) (3, ny, nx), unit integral.

        S(x) = K^-2 sum_nu P^(nu) exp(2 pi i nu.(x - c))      K > n + the PSF's own extent

    slopes: with the derivatives; else (1, ny, nx)
    """
    extent = int(np.ceil(max(psf.images.shape[1:]) * psf.spacing))
    n_fft = max(shape) + 2 * extent + 1
    n_fft += 1 - n_fft % 2
    nu = np.fft.fftfreq(n_fft)
    shift_y, shift_x = (np.exp(-2j * np.pi * nu * p) for p in position)
    spectrum = _spectrum(psf, n_fft) * shift_y[:, None] * shift_x
    spectra = [spectrum]
    if slopes:
        slope = -2j * np.pi * nu
        spectra += [slope[:, None] * spectrum, slope * spectrum]
    return np.fft.ifft2(spectra).real[:, : shape[0], : shape[1]].copy()


@functools.lru_cache(maxsize=N_SPECTRA)
def _spectrum(psf, n_fft):
    """P^ of the first band (n_fft, n_fft) in the order of the FFT."""
    nu = np.fft.fftfreq(n_fft)
    return psf.otf(nu, nu)[0]
