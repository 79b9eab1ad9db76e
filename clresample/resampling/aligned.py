"""Executor of aligned grids: rows and columns of both images are parallel."""

from __future__ import annotations

import numpy as np

from ..device.contraction import ImageBatch, row_stride
from .executor import Executor


class AlignedExecutor(Executor):
    """Grids whose axes are parallel, crossed or mirrored: four thin products each way.

    Sy (My, ky), Sx (kx, Mx): waves at the observed rows and columns, about their middle
    """

    def __init__(self, device, dtype, plans):
        sides = [(len(p.out_y), p.out_x.shape[1]) for p in plans]
        self.n_rows, self.n_columns = np.max(sides, axis=0).tolist()
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.k_x, row_stride(self.n_columns))

    def bind(self):
        super().bind()
        n_y, n_x = self.n_rows, self.n_columns
        half, z = self.matrix("half", n_y), self.matrix("frequencies")
        observed = ImageBatch.shaped(n_y, n_x).matrix()
        k_y, k_x, n = self.k_ys, self.k_xs, self.n_bands
        self.to_rows = self.waves("out_y", "left", back=True).bind(
            *(n_y, self.k_x, self.k_y),
            *(self.out_y, z, half),
            n_bands=n,
            inward=False,
            own=self.item_sizes(n=k_x, k=k_y),
        )
        self.to_pixels = self.waves("out_x", "right", back=True, ragged=True).bind(
            *(n_y, n_x, self.k_x),
            *(half, self.out_x, observed),
            n_bands=n,
            inward=False,
            own=self.item_sizes(k=k_x),
        )

    def bind_adjoint(self):
        super().bind_adjoint()
        n_y, n_x, n = self.n_rows, self.n_columns, self.n_bands
        half, observed = self.matrix("half", n_y), ImageBatch.shaped(n_y, n_x).matrix()
        out_y_t = self.cached("out_y_t", lambda: self._transposed("out_y", self.k_y, n_y))
        out_x_t = self.cached("out_x_t", lambda: self._transposed("out_x", n_x, self.k_pad))
        self.from_pixels = self.waves("out_x", "right").bind(
            n_y, self.k_x, n_x, observed, out_x_t, half, n_bands=n, own=self.item_sizes(n=self.k_xs)
        )
        product = self.waves("out_y", "left", **self.adjoint_options())
        self.from_rows = self.to_frequencies(product, n_y, out_y_t, half)

    def frequencies_to_pixels(self, y: ImageBatch, n):
        """I2 = Sy Z Sx;  y (n, My, Mx): the observation I2 of each band, overwritten"""
        self.to_rows(n)
        self.to_pixels(n, c=y)

    def pixels_to_frequencies(self, y: ImageBatch, n):
        """Z = conj(D) o (Sy^T I2 Sx^T);  y (n, My, Mx): I2"""
        self.from_pixels(n, a=y)
        self.from_rows(n)
