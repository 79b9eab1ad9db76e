"""Executor of any positions: the sum over frequencies for each observed pixel."""

from __future__ import annotations

import math

import numpy as np

from ..device.contraction import COLUMN_PAD, Matrix
from .executor import GROUP, Executor, Images, whole_groups


class DistortedExecutor(Executor):
    """Any positions: the spectral sum straight at each observed pixel."""

    def __init__(self, device, dtype, plans):
        self.n_rows = math.prod(plans[0].mapping.shape_out)
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.n_rows, self.k_pad)
        self.rowdot = device.kernel("warp.cl", "rowdot", dtype=dtype)
        self.rowscale = device.kernel("warp.cl", "rowscale", dtype=dtype)
        scalars = [np.int32, np.int32, np.int32, np.int32]
        for kernel in (self.rowdot, self.rowscale):
            kernel.set_scalar_arg_dtypes([*scalars, None, np.uint64, None, None])

    def forward(self, x: Images, y: Images, n, spread=False):
        self.analyse(x, n, spread)
        half, z = self._scratch("half", self.n_rows), self._scratch("spectrum")
        self.plain(self.n_rows, self.k_x, self.k_y, n, self.out_y, z, half)
        self._ends(self.rowdot, y, half)
        self.device.launch(self.rowdot, (whole_groups(self.n_rows), n), (GROUP, 1))

    def adjoint(self, y: Images, x: Images, n):
        half = self._scratch("half", self.n_rows)
        self._ends(self.rowscale, y, half)
        self.device.launch(self.rowscale, (self.k_pad, self.n_rows, n), (COLUMN_PAD, 1, 1))
        self.to_spectrum(self.mix_adjoint, self.n_rows, self.out_y_t, half, n)
        self.synthesise(x, n)

    def _ends(self, kernel, y: Images, half: Matrix):
        kernel.set_args(
            self.n_rows,
            self.k_pad,
            self.n_bands,
            len(self.plans),
            y.buffer,
            y.offset,
            half.buffer,
            self.out_x.buffer,
        )
