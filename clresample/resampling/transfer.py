"""The transfer function D between two PSFs, the reach of its kernel, its effect on noise.

D(nu) = |det A| P2^(A^T nu) / P1^(nu)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..drawing.display import CertificateDisplay
from ..sky.psf import PSF

# [1] Fraction of the observed PSF's light beyond the wrap radius. Images drawn by FFT ring at 1e-6.
WRAP_TOLERANCE = 1e-5
# Ratio of the wrap radius to the radius where the light ends (4.9 sigma of a Gaussian): the band's
# sharp edge makes the kernel ring beyond. At 1.5 (7.4 sigma, 1e-12 of a Gaussian's light) the light
# that wraps is under 4e-7 of an image, 0.06 dB at 58 dB. Larger factors only add frequencies.
WRAP_MARGIN = 1.5
# |P1^| below which the division is floored: 1e-6 of a point source's light per frequency, ten times
# the rounding of a PSF in float32.
DIVISION_FLOOR = 1e-6
# Amplification |D| / |det A| above which a warning is issued; PSFs that nearly agree stay a few per
# cent above 1. Then the fraction of the observed PSF's power that may be floored without a warning.
NOISY_GAIN, FLOORED_POWER = 2.0, 1e-3


@dataclass(frozen=True, eq=False)
class Certificate(CertificateDisplay):
    """Findings of the set-up of an operator.

    wrap_radius_px (2,) [model px]: reach (y, x) of the observed PSF, by which the model is padded
    n_fft (2,): K, the padded length of each axis; frequencies are kappa / K
    n_frequencies (2,): frequencies >= 0 of each axis that are summed
    max_gain (C,) [1]: largest |D| / |det A|, by which noise of that frequency is multiplied
    floored_power (C,) [1]: fraction of the observed PSF's power where |P1^| was floored
    """

    wrap_radius_px: tuple[float, float]
    n_fft: tuple[int, int]
    n_frequencies: tuple[int, int]
    max_gain: np.ndarray
    floored_power: np.ndarray

    def __repr__(self):
        (r_y, r_x), (k_y, k_x), (h_y, h_x) = self.wrap_radius_px, self.n_fft, self.n_frequencies
        return (
            f"Certificate(wraps at {r_y:.1f}, {r_x:.1f} px; K = {k_y}, {k_x}; "
            f"{h_y} x {h_x} frequencies; gain <= {self.max_gain.max():.3g}; "
            f"{self.floored_power.max():.2%} of the power floored)"
        )


def gain_warnings(certificate: Certificate) -> list[str]:
    """Warnings about a difference kernel that amplifies the noise of images it is applied to."""
    gain = certificate.max_gain.max()
    if gain <= NOISY_GAIN:
        return []
    return [
        f"the difference kernel amplifies some frequencies {gain:.3g} times, and noise "
        "with them: the model's PSF is wider there than the observation's"
    ]


def floor_warnings(certificate: Certificate) -> list[str]:
    """Warnings about a difference kernel whose division was floored."""
    floored = certificate.floored_power.max()
    if floored <= FLOORED_POWER:
        return []
    return [
        "the observed PSF has power where the model's has hardly any: the division is floored for "
        f"{floored:.2%} of it, at less than {DIVISION_FLOOR:g} of the model's light"
    ]


def wrap_radius(psf: PSF, matrix) -> tuple[float, float]:
    """Distance (y, x) [model px] beyond which the observed PSF has negligible light.

    With K >= N + radius, light that leaves one edge of the model does not enter at the other.

    psf: the observed one; matrix (2, 2) [model px / observed px]: A
    """
    reach, image = _light_ends(psf, WRAP_TOLERANCE)
    circle = np.linalg.norm(matrix, axis=1) * (WRAP_MARGIN * reach + psf.spacing)
    radius = np.minimum(circle, np.abs(matrix) @ image)
    return float(radius[0]), float(radius[1])


def light_reach(psf: PSF, matrix, tolerance) -> float:
    """Distance [model px] beyond which the observed PSF has less than this part of its light."""
    reach, image = _light_ends(psf, tolerance)
    circle = np.linalg.norm(matrix, axis=1) * reach
    return float(np.minimum(circle, np.abs(matrix) @ image).max())


def _light_ends(psf, tolerance):
    """Distance [px] beyond which lies this fraction of a PSF's light; half its image (2,) [px]."""
    y, x = (
        np.abs(np.arange(n) - psf.center[:, i, None]) * psf.spacing
        for i, n in enumerate(psf.images.shape[1:])
    )
    distance = np.hypot(y[:, :, None], x[:, None, :]).reshape(psf.n_bands, -1)
    light = np.abs(psf.images).reshape(psf.n_bands, -1)
    order = np.argsort(-distance, axis=1)
    beyond = np.take_along_axis(light, order, axis=1).cumsum(axis=1)
    lit = beyond > tolerance * beyond[:, -1:]
    reach = (np.take_along_axis(distance, order, axis=1) * lit).max()
    return reach, np.array([y.max(), x.max()]) + 0.5 * psf.spacing


def transfer_function(otf_in, otf_out):
    """D / |det A| = P2^ / P1^ from both OTFs, and the frequencies limited in the division.

    Computed as P2^ conj(P1^) / max(|P1^|, floor)^2: the exact ratio wherever the model's PSF
    carries more than DIVISION_FLOOR, falling to zero with |P1^| below it.

    otf_in, otf_out (C or 1, Ky, Kx) complex: P1^(nu), P2^(A^T nu); D itself if P2^ comes times
        |det A|, as in the paper's scheme
    returns the ratio (C, Ky, Kx), its largest size (C,), and the fraction (C,) of P2^'s power where
        the division was floored
    """
    size = np.abs(otf_in)
    ratio = otf_out * otf_in.conj() / np.maximum(size, DIVISION_FLOOR) ** 2
    power = np.abs(otf_out) ** 2
    floored = (power * (size < DIVISION_FLOOR)).sum(axis=(1, 2)) / power.sum(axis=(1, 2))
    return ratio, np.abs(ratio).max(axis=(1, 2)), floored
