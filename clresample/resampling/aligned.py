"""Executor of aligned grids: rows and columns of both images are parallel."""

from __future__ import annotations

from ..device.contraction import ImageBatch, padded
from .executor import Executor


class AlignedExecutor(Executor):
    """Grids whose axes are parallel, crossed or mirrored: four thin products each way.

    Sy (My, ky), Sx (kx, Mx): waves at the observed rows and columns
    """

    def __init__(self, device, dtype, plans):
        self.n_rows, self.n_columns = plans[0].mapping.shape_out
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.k_x, padded(self.n_columns))
        self.out_x_t = self._table([p.out_x.T for p in plans], self.n_columns, self.k_pad)

    def bind(self):
        super().bind()
        n_y, n_x = self.n_rows, self.n_columns
        half, z = self.matrix("half", n_y), self.matrix("frequencies")
        observed = ImageBatch.shaped(n_y, n_x).matrix()
        self.to_rows = self.plain.bind(n_y, self.k_x, self.k_y, self.out_y, z, half, inward=False)
        self.to_pixels = self.ragged.bind(
            n_y, n_x, self.k_x, half, self.out_x, observed, inward=False
        )
        self.from_pixels = self.plain.bind(n_y, self.k_x, n_x, observed, self.out_x_t, half)
        self.from_rows = self.to_frequencies(self.mix_adjoint, n_y, self.out_y_t, half)

    def observe(self, y: ImageBatch, n):
        """I2 = Sy Z Sx;  y (n, My, Mx): the observation I2 of each band, overwritten"""
        self.to_rows(n)
        self.to_pixels(n, c=y)

    def collect(self, y: ImageBatch, n):
        """Z = conj(D) o (Sy^T I2 Sx^T);  y (n, My, Mx): I2"""
        self.from_pixels(n, a=y)
        self.from_rows(n)
