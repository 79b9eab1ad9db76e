"""The prior of morphologies: structure about a smooth profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SingleScalePrior:
    """Prior on a morphology: S = p + alpha sqrt(p) K z, z unit normal.

    p is the expected smooth profile. The structure of galaxies consists of clumps, whose number,
    and so the variance, is proportional to the light: hence the root.

    strength [1]: scatter of the brightest pixel about its expected value, relative to it; larger
        ones let more of the noise into the morphology
    correlation_px [model px]: Gaussian sigma of the kernel K that correlates neighbours; larger
        ones keep the structure smoother
    """

    strength: float = 0.1
    correlation_px: float = 2.0

    def amplitude(self, profile) -> np.ndarray:
        """Scatter of a profile's pixels: alpha sqrt(p); 0 where a star's wings are negative."""
        return self.strength * np.sqrt(np.maximum(profile, 0))

    @property
    def taps(self) -> np.ndarray:
        """K along one axis (2 radius + 1), cut at 3 sigma, so that K z has unit variance."""
        radius = int(np.ceil(3 * self.correlation_px))
        sigma_px = max(self.correlation_px, 1e-3)  # narrower ones reach no neighbour either
        k = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_px) ** 2)
        return k / np.linalg.norm(k)
