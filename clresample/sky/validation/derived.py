"""Quantities that follow from the fields of an Observation: whitened images, chi2, fluxes."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..correlation import NoiseCorrelation
from ..grid import Grid
from ..psf import PSF
from ..varying_psf.derived import filter_psf
from ..varying_psf.field import PSFField

# [mag] AB magnitude of 1 uJy
ZERO_POINT_UJY = 23.9


class DerivedQuantities:
    """Mixin of Observation."""

    data: np.ndarray
    psf: PSF
    psf_field: PSFField | None
    grid: Grid
    weights: np.ndarray
    zero_points: np.ndarray | None
    noise: tuple[NoiseCorrelation, ...] | None

    @cached_property
    def whitened(self):
        """The observation with white noise, which is fitted; itself if its noise is white.

        Data and PSF are convolved with each channel's whitening filter. A constant is preserved,
        and pixels nearer to a mask or to the edge than the filter's radius have weight 0.
        """
        if self.noise is None:
            return self
        psf, sums = filter_psf(self.psf, self.psf_field, [n.filter for n in self.noise])
        data = self.whiten(self.data)
        weights = np.stack(
            [n.valid_after_filter(w) * w * s**2 for n, w, s in zip(self.noise, self.weights, sums)]
        )
        names = {key: getattr(self, key) for key in ("channels", "bands", "zero_points", "name")}
        return type(self)(data, psf, self.grid, weights=weights, **names)

    def whiten(self, images) -> np.ndarray:
        """Filters images (C, Ny, Nx) of this observation as in `whitened`."""
        if self.noise is None:
            return images
        pairs = zip(self.noise, images, strict=True)
        return np.stack([n.filtered(image) / n.filter.sum() for n, image in pairs])

    def chi2_map(self, residual) -> np.ndarray:
        """Weighted squared residuals (C, Ny, Nx) of expectation 1; NaN where weights are 0.

        residual (C, Ny, Nx) [counts]: data minus model; whitened here if the noise is correlated
        """
        weights = self.weights
        if self.noise is None:
            squares = residual**2
        else:
            variance = np.array([n.variance for n in self.noise])
            squares = self.whiten(residual) ** 2 / variance[:, None, None]
            weights = self.whitened.weights
        return np.where(weights > 0, weights * squares, np.nan)

    @property
    def flux_scale(self) -> np.ndarray | None:
        """Flux of one count (C,) [uJy]; None without zero points.

        It is 10^(-0.4 (zero_points - 23.9)).
        """
        if self.zero_points is None:
            return None
        return 10 ** (-0.4 * (self.zero_points - ZERO_POINT_UJY))
