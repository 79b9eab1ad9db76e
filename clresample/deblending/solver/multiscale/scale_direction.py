"""Change of a source's coefficients that scales its profile, constrained by the prior alone.

S = p + u - p <p, u> / <p, p> does not change if u is proportional to p: the projection subtracts
it. Such coefficients have the curvature of the prior alone, but blocks of a part of the box contain
their light as any other's. So L-BFGS adds to them at first and takes hundreds of iterations to
remove them, each of which lowers the loss and changes no flux. The direction d with u = p of the
smallest |z|^2 / alpha^2 has an inverse curvature of its own, d d^T / (d^T H d), which is added to
that of the blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .prior import correlations, kernel_rows, without_profile

# Conjugate gradients for a wanted u, and the variance [1] that is added to the prior's of
# u / sqrt(p): with 30 and 1e-5 the data's curvature along the direction is a tenth of the prior's
# for a giant of signal to noise 7000 (bench.ladder), and five times it with 10 and 1e-4. With 12
# steps for exchange directions HST with HSC takes 928 iterations in place of 98 (bench.real).
N_STEPS, VARIANCE = 30, 1e-5
# [px] Largest side of images that are multiplied by matrices along both axes. Transforms take eight
# times as long at a side of 24 and 1.5 times at 96, and matrices 1.4 times as long at 128.
MAX_MATRIX_SIDE = 96


@dataclass(frozen=True, eq=False)
class ScaleDirection:
    """The direction d of one source, scaled to d^T H d = 1: values (all its coefficients,)."""

    values: np.ndarray


def scale_coefficients(prior, profile, strengths):
    """Coefficients [j] (ny_j, nx_j) with u = p, nearly, and the change (ny, nx) of S by them."""
    z, u = coefficients_of(prior, profile, profile, strengths)
    return z, without_profile(u, profile)


def coefficients_of(prior, profile, wanted, strengths, window=None):
    """Coefficients [j] (ny_j, nx_j) whose u is nearly the image `wanted` (my, mx), and their u.

    They are alpha_j^2 K_j^T (sqrt(p) q), (sqrt(p) P sqrt(p) + VARIANCE) q = wanted,
    P = sum_j alpha_j^2 K_j K_j^T.

    window: the slices of the profile (ny, nx) that are the image; None = all of it
    """
    window = window or tuple(slice(0, n) for n in profile.shape)
    root = prior.amplitude(profile[window])
    variance = np.square(strengths).astype(np.float32)
    correlate = _prior_correlation(prior, variance, root.shape)
    q, left = np.zeros_like(wanted), wanted.copy()
    step, size2 = left.copy(), np.vdot(left, left)
    for _ in range(N_STEPS):
        curved = root * correlate(root * step) + VARIANCE * step
        length = size2 / max(np.vdot(step, curved), 1e-30)
        q += length * step
        left -= length * curved
        before, size2 = size2, np.vdot(left, left)
        step = left + size2 / max(before, 1e-30) * step
    sides = [
        [kernel_rows(prior, j, n)[:, at] for n, at in zip(profile.shape, window, strict=True)]
        for j in range(len(variance))
    ]
    z = [v * (y @ (root * q) @ x.T) for v, (y, x) in zip(variance, sides, strict=True)]
    return z, root * sum(y.T @ part @ x for part, (y, x) in zip(z, sides, strict=True))


def _prior_correlation(prior, variance, shape):
    """The function that multiplies images of a shape by P; variance (J,): alpha_j^2, float32."""
    n_y, n_x = shape
    if max(shape) <= MAX_MATRIX_SIDE:
        along_y = np.concatenate([*(variance[:, None, None] * correlations(prior, n_y))], axis=1)
        along_x = correlations(prior, n_x)
        return lambda image: along_y @ (image @ along_x).reshape(-1, n_x)
    from scipy import fft  # takes 0.05 s, not needed by small galaxies

    size = [fft.next_fast_len(n + 2 * max(prior.radii), real=True) for n in shape]
    power = 0
    for part, taps in zip(variance, prior.kernels(), strict=True):
        y, x = (np.abs(np.fft.fft(taps, n)) ** 2 for n in size)
        power = power + part * np.outer(y, x[: size[1] // 2 + 1])
    power = power.astype(np.float32)
    return lambda image: fft.irfft2(fft.rfft2(image, size) * power, size)[:n_y, :n_x]
