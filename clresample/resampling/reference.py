"""The operator in NumPy float64, written from its definitions.

The tests compare executors with it.

With A the Jacobian and X the positions of the observed pixels in model pixels, nu = kappa / K:

    D(nu)  = |det A| P2^(A^T nu) / P1^(nu)
    I2(X)  = K^-2 sum_nu D(nu) F[I1](nu) exp(2 pi i nu.X)                         frequency_sum
    I2(X)  = sum_k I1(x_k) sum_m Pd(x_m) sinc(X - x_k - x_m),  Pd = F^-1[D]         dense_matrix

The sums are complete, without separation or interpolation, and therefore for small images only.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .transfer import DIVISION_FLOOR

__all__ = ["dense_matrix", "difference_kernel", "resample", "frequency_sum", "otf_ratio"]


def resample(images, mapping, psf_in, psf_out, n_fft):
    """I2 at every pixel of `mapping`, 0 where the model does not cover it.

    images (..., C, Ny, Nx) [flux/px]: model; n_fft (2,): K of each axis, odd
    returns (..., C, My, Mx)
    """
    positions = mapping.at(*np.indices(mapping.shape_out))
    scale = mapping.covered * (1.0 if mapping.area is None else mapping.area)
    return scale * frequency_sum(images, positions, mapping.matrix, psf_in, psf_out, n_fft)


def frequency_sum(images, positions, matrix, psf_in, psf_out, n_fft):
    """I2(X) = K^-2 sum_nu D(nu) F[I1](nu) exp(2 pi i nu.X), summed for each position by itself.

    images (..., C, Ny, Nx) [flux/px]; positions (*P, 2) [model px]: X; matrix (2, 2): A
    returns (..., C, *P): flux in an observed pixel of area |det A| at X
    """
    nu_y, nu_x, d = otf_ratio(matrix, psf_in, psf_out, n_fft)
    n_y, n_x = np.shape(images)[-2:]
    f = _wave(nu_y, -np.arange(n_y)) @ images @ _wave(-np.arange(n_x), nu_x)
    z = d * f / (n_fft[0] * n_fft[1])
    y, x = np.reshape(positions, (-1, 2)).T
    result = np.sum((_wave(y, nu_y) @ z) * _wave(x, nu_x), axis=-1).real
    return result.reshape(result.shape[:-1] + np.shape(positions)[:-1])


def dense_matrix(shape_in, positions, matrix, psf_in, psf_out, n_fft):
    """R of I2 = R I1, term by term: R[p, k] = sum_m Pd(x_m) sinc(X_p - x_k - x_m).

    shape_in (Ny, Nx) [px]: model; positions (*P, 2) [model px]; matrix (2, 2): A
    n_fft (2,): the kernel is kept to |x_m| <= (K - 1) / 2
    returns (C, P, Ny Nx); its sincs are infinite, so it equals the spectral sum if Pd vanishes
        beyond K
    Source: eqs. `reconvampling2D`, `I2model`.
    """
    kernel = difference_kernel(matrix, psf_in, psf_out, n_fft)
    sincs = []
    for x, n, k in zip(np.reshape(positions, (-1, 2)).T, shape_in, n_fft, strict=True):
        reach = np.arange(-(k // 2), n + k // 2)  # x_k + x_m
        sincs.append(sliding_window_view(np.sinc(x[:, None] - reach), k, axis=1))
    y, x = sincs  # (P, N, K)
    rows = y @ kernel[:, None] @ x.swapaxes(1, 2)
    return rows.reshape(*rows.shape[:2], -1)


def difference_kernel(matrix, psf_in, psf_out, n_fft):
    """Pd(x_m) = K^-2 sum_nu D(nu) exp(2 pi i nu.x_m), x_m = -(K-1)/2 ... (K-1)/2 on both axes.

    returns (C, Ky, Kx). Source: the quotient below eq. `psf_interp`, times |det A|, the ratio of
    pixel areas.
    """
    nu_y, nu_x, d = otf_ratio(matrix, psf_in, psf_out, n_fft)
    m_y, m_x = (np.arange(k) - k // 2 for k in n_fft)
    return (_wave(m_y, nu_y) @ d @ _wave(nu_x, m_x)).real / (n_fft[0] * n_fft[1])


def otf_ratio(matrix, psf_in, psf_out, n_fft):
    """D on both halves of both axes, nu = -(K-1)/2K ... (K-1)/2K: (nu_y, nu_x, D (C, Ky, Kx)).

    Where |P1^| is under DIVISION_FLOOR, D = |det A| P2^ conj(P1^) / DIVISION_FLOOR^2.
    Raises ValueError for an even K, whose Nyquist term has no partner.
    """
    if n_fft[0] % 2 == 0 or n_fft[1] % 2 == 0:
        raise ValueError(f"n_fft is {tuple(n_fft)}, both must be odd")
    nu_y, nu_x = ((np.arange(k) - k // 2) / k for k in n_fft)
    p1, p2 = psf_in.otf(nu_y, nu_x), psf_out.otf(nu_y, nu_x, matrix)
    size = np.maximum(np.abs(p1), DIVISION_FLOOR)
    return nu_y, nu_x, abs(np.linalg.det(matrix)) * p2 * p1.conj() / size**2


def _wave(a, b):
    """exp(2 pi i a b), (len(a), len(b))."""
    return np.exp(2j * np.pi * np.multiply.outer(a, b))
