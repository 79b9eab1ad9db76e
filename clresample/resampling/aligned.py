"""Executor of aligned grids: rows and columns of both images are parallel."""

from __future__ import annotations

from ..device.contraction import padded
from .executor import Executor, Images


class AlignedExecutor(Executor):
    """Grids whose axes are parallel, crossed or mirrored: four thin products each way."""

    def __init__(self, device, dtype, plans):
        self.n_rows, self.n_columns = plans[0].mapping.shape_out
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.k_x, padded(self.n_columns))
        self.out_x_t = self._table([p.out_x.T for p in plans], self.n_columns, self.k_pad)

    def forward(self, x: Images, y: Images, n, spread=False):
        self.analyse(x, n, spread)
        half, z = self._scratch("half", self.n_rows), self._scratch("spectrum")
        self.plain(self.n_rows, self.k_x, self.k_y, n, self.out_y, z, half)
        self.ragged(self.n_rows, self.n_columns, self.k_x, n, half, self.out_x, y.matrix())

    def adjoint(self, y: Images, x: Images, n):
        half = self._scratch("half", self.n_rows)
        self.plain(self.n_rows, self.k_x, self.n_columns, n, y.matrix(), self.out_x_t, half)
        self.to_spectrum(self.mix_adjoint, self.n_rows, self.out_y_t, half, n)
        self.synthesise(x, n)
