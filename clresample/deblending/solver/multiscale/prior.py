"""The multi-scale prior: structure at several scales, with strengths found from the data."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MultiscalePrior:
    """Prior on a morphology: structure of a strength that its own data determine.

        S = max(0, p + u - p <p, u> / <p, p>),      u = sqrt(p) sum_j K_j z_j

    p is the expected smooth profile, K_j a Gaussian kernel of unit variance, and z_j is normal with
    scatter strength_j, which starts at `strengths` and is estimated for each source and scale. The
    structure of galaxies consists of clumps, whose number, and so the variance, is proportional to
    the light: hence the root. The projection on the profile is subtracted, since the spectrum fits
    it.

    scales_px [model px]: Gaussian sigmas of the kernels, ascending: the model PSF's own width,
        galaxies' clumps, their wings
    strengths [1]: typical scatter of the brightest pixel about its expected value, relative to it,
        at each scale; medians of fits to simulated galaxies
    hyperprior_weight [px]: number of determined parameters with the same weight as `strengths`:
        with larger values a source's own data have less influence. A faint galaxy determines 10 to
        60 parameters, a bright blend of HSC thousands. A tenth is used at the finest scale for
        significant structure, as in cores of bright galaxies
    """

    scales_px: tuple[float, ...] = (0.8, 2.0, 5.0)
    strengths: tuple[float, ...] = (0.005, 0.1, 0.02)
    hyperprior_weight: float = 100.0

    def __post_init__(self):
        scales, strengths = np.array(self.scales_px, float), np.array(self.strengths, float)
        if scales.ndim != 1 or scales.shape != strengths.shape or not len(scales):
            raise ValueError(
                f"scales_px is {self.scales_px} and strengths {self.strengths}: they take a "
                "number for each of at least one scale"
            )
        if not (scales > 0).all() or not (strengths > 0).all() or not self.hyperprior_weight > 0:
            raise ValueError(f"{self} must hold positive numbers only")

    def amplitude(self, profile) -> np.ndarray:
        """Root of a profile's light, the scatter of structure of strength 1; 0 where negative."""
        return np.sqrt(np.maximum(profile, 0))

    @property
    def steps(self) -> tuple[int, ...]:
        """Pixels between neighbouring coefficients of each scale.

        The largest power of two up to sigma, at which a Gaussian has 0.7 % of its amplitude left at
        the Nyquist frequency.
        """
        return tuple(2 ** max(0, int(np.floor(np.log2(s)))) for s in self.scales_px)

    @property
    def radii(self) -> tuple[int, ...]:
        """Of the kernels [px], cut at 3 sigma."""
        return tuple(int(np.ceil(3 * s)) for s in self.scales_px)

    def kernels(self) -> list[np.ndarray]:
        """Each K_j along one axis, (2 radius + 1): sum of squares 1, on every pixel."""
        return [gaussian(s, r) for s, r in zip(self.scales_px, self.radii, strict=True)]


def gaussian(sigma, radius, *, unit_sum=False):
    """A Gaussian (2 radius + 1), sum of squares 1, or sum 1."""
    k = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return k / (k.sum() if unit_sum else np.linalg.norm(k))


def without_profile(image, profile):
    """An image (ny, nx) less its projection on a profile (ny, nx)."""
    return image - profile * ((profile * image).sum() / max(np.square(profile).sum(), 1e-30))


@functools.lru_cache(maxsize=128)
def kernel_rows(prior, j, n):
    """K_j of each coefficient along a side of `n` pixels (n_j, n)."""
    step, taps = prior.steps[j], prior.kernels()[j]
    at = np.arange(0, n + step - 1, step)
    lag = np.arange(n) - at[:, None] + len(taps) // 2
    inside = (lag >= 0) & (lag < len(taps))
    return (np.sqrt(step) * np.where(inside, taps[np.where(inside, lag, 0)], 0)).astype(np.float32)


@functools.lru_cache(maxsize=128)
def correlations(prior, n):
    """K_j K_j^T of each scale along a side of `n` pixels (J, n, n), of kernels on every pixel."""
    lag = np.abs(np.arange(n)[:, None] - np.arange(n))
    rows = np.zeros((len(prior.scales_px), max(n, 2 * max(prior.radii) + 1)))
    for row, taps in zip(rows, prior.kernels(), strict=True):
        row[: len(taps)] = np.correlate(taps, taps, "full")[len(taps) - 1 :]
    return rows[:, lag].astype(np.float32)
