"""The transfer function D between two PSFs, and how far its kernel reaches.

D(nu) = |det A| P2^(A^T nu) / P1^(nu)
"""

from __future__ import annotations

import numpy as np

from ..sky.psf import PSF

# Light of the observed PSF beyond the wrap radius, as a fraction; images drawn by FFT ring at 1e-6.
WRAP_TOLERANCE = 1e-5
# A Gaussian reaches that at 4.9 sigma, and the sharp edge of the band rings beyond: half as much
# again (7.4 sigma, 1e-12 of the light) keeps what wraps below 4e-7 of an image, 0.06 dB at 58 dB.
WRAP_MARGIN = 1.5
# |P1^| below which the division is floored: 1e-6 of a point source's light per frequency, ten times
# the rounding of a PSF stored in float32.
DIVISION_FLOOR = 1e-6


def wrap_radius(psf: PSF, matrix) -> tuple[float, float]:
    """Distance (y, x) [model px] beyond which the observed PSF holds no light worth wrapping.

    K >= N + radius keeps what leaves one edge of the model from coming in at the other.
    """
    y, x = (
        np.abs(np.arange(n) - psf.center[:, i, None]) * psf.spacing
        for i, n in enumerate(psf.images.shape[1:])
    )
    distance = np.hypot(y[:, :, None], x[:, None, :]).reshape(psf.n_bands, -1)
    light = np.abs(psf.images).reshape(psf.n_bands, -1)
    order = np.argsort(-distance, axis=1)
    beyond = np.take_along_axis(light, order, axis=1).cumsum(axis=1)
    lit = beyond > WRAP_TOLERANCE * beyond[:, -1:]
    reach = (np.take_along_axis(distance, order, axis=1) * lit).max()
    circle = np.linalg.norm(matrix, axis=1) * (WRAP_MARGIN * reach + psf.spacing)
    image = np.abs(matrix) @ (np.array([y.max(), x.max()]) + 0.5 * psf.spacing)
    radius = np.minimum(circle, image)
    return float(radius[0]), float(radius[1])


def transfer_function(matrix, psf_in: PSF, psf_out: PSF, nu_y, nu_x):
    """D on nu_y >= 0 and nu_x from -max to +max, and a report of what the division had to do.

    D = |det A| P2^ conj(P1^) / max(|P1^|, floor)^2: the exact ratio wherever the model's PSF
    carries more than DIVISION_FLOOR, falling to zero with |P1^| below it.
    """
    both = np.concatenate([-nu_x[:0:-1], nu_x])
    p1 = psf_in.spectrum(nu_y, both)
    p2 = psf_out.spectrum(nu_y, both, matrix)
    size = np.abs(p1)
    ratio = p2 * p1.conj() / np.maximum(size, DIVISION_FLOOR) ** 2
    power = np.abs(p2) ** 2
    floored = (power * (size < DIVISION_FLOOR)).sum(axis=(1, 2)) / power.sum(axis=(1, 2))
    report = {"max_gain": np.abs(ratio).max(axis=(1, 2)), "floored_power": floored}
    return abs(np.linalg.det(matrix)) * ratio, report
