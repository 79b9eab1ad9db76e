"""Mosaics as pipelines make them: Lanczos resampling and drizzle, with correlated noise.

Both are linear. With the pixels d_k of all exposures, of noise sigma, a mosaic's pixels are

    m_i = sum_k M_ik d_k,      variance_i = sigma^2 sum_k M_ik^2
    PSF(v) = < sum_k M_ik P(v - c_i + x_k) >

where c_i and x_k are the centres of pixels and < > is the mean over the mosaic. Neighbouring pixels
share input pixels, so their noise is correlated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..sky.correlation import NoiseCorrelation
from ..sky.grid import Grid
from ..sky.psf import PSF

# Pixels of a mosaic over which its correlation and its PSF are averaged: all sub-pixel phases.
N_MEAN = 1500
# Lags of the correlation [input px]: Lanczos-3 sums over 6 pixels a side.
MAX_LAG_PX = 6
# Smallest fraction of a mosaic's pixel covered by drops for it to have a value.
MIN_FILLED = 1e-3


@dataclass(frozen=True, eq=False)
class MosaicOperator:
    """Operator from exposures to a mosaic.

    grid_in: `Grid.flat` of the exposures' pixels, all of one Jacobian; grid: of the mosaic
    matrix (P, P_in): M, over the pixels of all exposures one after the other; rows of zeros where
        the exposures do not reach
    centers (P_in, 2) [mosaic px]: of the exposures' pixels
    """

    grid_in: Grid
    grid: Grid
    matrix: sparse.csr_matrix
    centers: np.ndarray

    @property
    def has_data(self):
        """Pixels (Ny, Nx) that have a value."""
        return (np.diff(self.matrix.indptr) > 0).reshape(self.grid.shape)

    def images(self, exposures):
        """Mosaics (C, Ny, Nx) of exposures, a sequence of (C, ny, nx) [counts per pixel]."""
        flat = np.concatenate([e.reshape(len(e), -1) for e in map(np.asarray, exposures)], axis=1)
        return (self.matrix @ flat.T).T.reshape(-1, *self.grid.shape)

    def variance(self):
        """Variance (Ny, Nx) of the mosaic's pixels where that of the exposures' is 1."""
        return np.asarray(self.matrix.power(2).sum(axis=1)).reshape(self.grid.shape)

    def correlation(self) -> NoiseCorrelation:
        """Mean correlation of two pixels' noise over the mosaic, in units of their own scatters."""
        rows, offsets = self._sample()
        scatter = np.sqrt(self.variance().ravel())
        scaled = sparse.diags(1 / np.where(scatter > 0, scatter, 1)) @ self.matrix
        products = (scaled[rows] @ scaled.T).tocoo()
        step = abs(np.linalg.det(self.grid_in.map_to(self.grid).matrix)) ** 0.5
        reach = round(MAX_LAG_PX * step)
        here, there = (np.stack(np.unravel_index(i, self.grid.shape)) for i in (rows, products.col))
        lag = there - here[:, products.row] + reach
        inside = ((lag >= 0) & (lag <= 2 * reach)).all(axis=0)
        rho = np.zeros((2 * reach + 1,) * 2)
        np.add.at(rho, tuple(lag[:, inside]), products.data[inside])
        return NoiseCorrelation((rho + rho[::-1, ::-1]) / (2 * len(rows)))

    def psf(self, psf: PSF) -> PSF:
        """The mosaic's PSF, from that of the exposures, pixel response included."""
        mapping = self.grid_in.map_to(self.grid)
        scale = abs(np.linalg.det(mapping.matrix)) ** 0.5  # [mosaic px / px]
        n_y, n_x = (2 * int(np.ceil(n * psf.spacing * scale / 2)) + 1 for n in psf.images.shape[1:])
        nu_y, nu_x = (np.fft.fftfreq(n + 2 * round(MAX_LAG_PX * scale)) for n in (n_y, n_x))
        rows, offsets = self._sample()
        wave_y, wave_x = (
            np.exp(-2j * np.pi * np.outer(nu, along))
            for nu, along in zip((nu_y, nu_x), offsets.T, strict=True)
        )
        mean = (wave_y * self.matrix[rows].data) @ wave_x.T / len(rows)
        otf = psf.otf(nu_y, nu_x, mapping.matrix) * mean
        images = np.fft.fftshift(np.fft.ifft2(otf).real, axes=(1, 2))
        middle = [n // 2 for n in images.shape[1:]]
        box = tuple(slice(m - n // 2, m + n // 2 + 1) for m, n in zip(middle, (n_y, n_x)))
        return PSF(images[:, *box])

    def _sample(self):
        """Some rows (n,) of the matrix, and for each of their entries c_i - x_k (., 2) [px]."""
        rows = np.flatnonzero(self.has_data.ravel())
        if not len(rows):
            raise ValueError(f"the exposures reach no pixel of the mosaic's grid {self.grid.shape}")
        if len(rows) > N_MEAN:
            rows = np.sort(np.random.default_rng(0).choice(rows, N_MEAN, replace=False))
        part = self.matrix[rows]
        own = np.stack(np.unravel_index(rows, self.grid.shape), axis=1)
        own = np.repeat(own, np.diff(part.indptr), axis=0)
        return rows, own - self.centers[part.indices]


def lanczos(grid_in, grid, order=3) -> MosaicOperator:
    """Lanczos interpolation of one exposure, whose weights are normalised pixel by pixel.

        M_ik ~ L(y_i - n_k) L(x_i - m_k),   L(u) = sinc(u) sinc(u / order), |u| < order

    grid_in, grid: `Grid.flat` of the exposure and of the mosaic
    order: 3 as usual, of 6 x 6 input pixels; those that are not all there give no value

    Raises ValueError for an order under 1 and grids that are not flat.
    """
    if order < 1:
        raise ValueError(f"order is {order}, must be 1 or more")
    _check_flat(grid_in, grid)
    mapping = grid.map_to(grid_in)
    at = mapping.at(*np.indices(grid.shape)).reshape(-1, 2)
    first = np.floor(at).astype(int) - order + 1
    taps = first[:, :, None] + np.arange(2 * order)  # (P, 2, 2 order)
    away = at[:, :, None] - taps
    weights = np.sinc(away) * np.sinc(away / order) * (np.abs(away) < order)
    weights /= weights.sum(axis=2, keepdims=True)
    whole = ((first >= 0) & (first + 2 * order <= grid_in.shape)).all(axis=1)
    values = np.einsum("py,px->pyx", weights[whole, 0], weights[whole, 1])
    columns = taps[whole, 0][:, :, None] * grid_in.shape[1] + taps[whole, 1][:, None]
    rows = np.broadcast_to(np.flatnonzero(whole)[:, None, None], values.shape)
    values *= abs(np.linalg.det(mapping.matrix))  # [input px] area of a mosaic's pixel
    size = np.prod(grid.shape), np.prod(grid_in.shape)
    entries = values.ravel(), (rows.ravel(), columns.ravel())
    return MosaicOperator(
        grid_in, grid, sparse.csr_matrix(entries, size), _centers([grid_in], grid)
    )


def drizzle(grids_in, grid, pixfrac=0.8) -> MosaicOperator:
    """Drizzle with square drops (Fruchter and Hook 2002), all exposures with the same weight.

        M_ik ~ area of pixel i that is covered by the drop of pixel k

    grids_in: `Grid.flat` of each exposure, of one Jacobian; grid: of the mosaic, at any angle
    pixfrac: side of a drop in input pixels, over 0 and at most 1

    Raises ValueError for another pixfrac, grids of several Jacobians, and grids that are not flat.
    """
    if not 0 < pixfrac <= 1:
        raise ValueError(f"pixfrac is {pixfrac}, must be above 0 and at most 1")
    _check_flat(*grids_in, grid)
    if any(not np.allclose(g.jacobian, grids_in[0].jacobian, rtol=1e-9) for g in grids_in):
        raise ValueError("grids_in have several Jacobians, a mosaic here takes exposures of one")
    mapping = grids_in[0].map_to(grid)
    half = pixfrac / 2
    corners = np.array([(-half, -half), (-half, half), (half, half), (half, -half)])
    corners = corners @ mapping.matrix.T
    centers = _centers(grids_in, grid)
    low = np.floor(centers + corners.min(axis=0) + 0.5).astype(int)
    span = np.ceil(np.ptp(corners, axis=0)).astype(int) + 1
    parts = []
    for step in np.ndindex(*span):
        pixel = low + step
        area = overlap_area(centers[:, None] + corners - (pixel[:, None] - 0.5))
        hit = (area > 0) & (pixel >= 0).all(axis=1) & (pixel < grid.shape).all(axis=1)
        rows = np.ravel_multi_index(tuple(pixel[hit].T), grid.shape)
        parts.append((area[hit], rows, np.flatnonzero(hit)))
    area, rows, columns = (np.concatenate(p) for p in zip(*parts, strict=True))
    matrix = sparse.csr_matrix((area, (rows, columns)), (np.prod(grid.shape), len(centers)))
    filled = np.asarray(matrix.sum(axis=1)).ravel()
    scale = np.where(filled > MIN_FILLED, 1 / np.maximum(filled, MIN_FILLED), 0)
    matrix = (sparse.diags(scale / abs(np.linalg.det(mapping.matrix))) @ matrix).tocsr()
    matrix.eliminate_zeros()
    return MosaicOperator(grids_in[0], grid, matrix, centers)


def overlap_area(polygons):
    """Areas (n,) that polygons (n, k, 2), convex or not, share with the square [0, 1] x [0, 1].

    By Green's theorem: the sum over their sides of the integral of y, cut to [0, 1], along x.
    """
    (y0, x0), (y1, x1) = (np.moveaxis(p, -1, 0) for p in (polygons, np.roll(polygons, -1, axis=1)))
    steep = np.abs(x1 - x0) < 1e-12
    slope = (y1 - y0) / np.where(steep, 1, x1 - x0)
    a, b = np.clip(x0, 0, 1), np.clip(x1, 0, 1)
    ya, yb = y0 + slope * (a - x0), y0 + slope * (b - x0)
    level = np.abs(yb - ya) < 1e-9
    mean = np.where(level, np.clip(0.5 * (ya + yb), 0, 1), 0)
    np.divide(_risen(yb) - _risen(ya), yb - ya, out=mean, where=~level)
    return np.abs(np.where(steep, 0, (b - a) * mean).sum(axis=1))


def _risen(y):
    """The integral of clip(y, 0, 1) from 0 to y."""
    inside = np.clip(y, 0, 1)
    return 0.5 * inside**2 + np.maximum(y - 1, 0)


def _centers(grids_in, grid):
    """Centres (P_in, 2) [mosaic px] of the pixels of all exposures."""
    return np.concatenate(
        [g.map_to(grid).at(*np.indices(g.shape)).reshape(-1, 2) for g in grids_in]
    )


def _check_flat(*grids):
    """Raises ValueError for a grid with a celestial WCS."""
    if not all(g.is_flat for g in grids):
        raise ValueError("a grid has a celestial WCS; mosaics are made on flat grids (Grid.flat)")
