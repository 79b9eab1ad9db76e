"""Executor of any positions: the sum over frequencies for each observed pixel."""

from __future__ import annotations

import math

from ..device.contraction import ImageBatch
from .executor import Executor


class DistortedExecutor(Executor):
    """Any positions: the sum over frequencies straight at each of the P = My Mx observed pixels.

    Sy (P, ky), Sx (P, kx): waves at the pixels, Sy times the pixel's area
    """

    bounded = False  # its sums along a pixel's row of tables run over all columns

    def __init__(self, device, dtype, plans):
        self.n_rows = math.prod(plans[0].mapping.shape_out)
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.n_rows, self.k_pad)

    def bind(self):
        super().bind()
        half, z = self.matrix("half", self.n_rows), self.matrix("frequencies")
        self.to_rows = self.product().bind(
            self.n_rows, self.k_x, self.k_y, self.out_y, z, half, inward=False
        )
        self.rowdot = self._rows("rowdot", (self.tuning.line_group, 1), half).bind(n=self.k_x)

    def bind_adjoint(self):
        super().bind_adjoint()
        half = self.matrix("half", self.n_rows)
        out_y_t = self.cached("out_y_t", lambda: self._transposed("out_y", self.k_y, self.n_rows))
        product = self.product(**self.adjoint_options())
        self.from_rows = self.to_frequencies(product, self.n_rows, out_y_t, half)
        self.rowscale = self._rows("rowscale", (self.tuning.line_group, 1), half)

    def _rows(self, name, local_size, half):
        """A kernel over the pixels' rows of tables."""
        return self.device.launcher("warp.cl", name, dtype=self.dtype, local_size=local_size).bind(
            n_positions=self.n_rows,
            n_pad=self.k_pad,
            n_bands=self.n_bands,
            n_tables=len(self.plans),
            T=half.buffer,
            E=self.out_x.buffer,
        )

    def frequencies_to_pixels(self, y: ImageBatch, n):
        """I2[p] = sum_x (Sy Z)[p, x] Sx[p, x];  y (n, P): the observation I2 of each band"""
        self.to_rows(n)
        self.rowdot((self.whole_groups(self.n_rows), n), y=y.buffer, y_offset=y.offset)

    def pixels_to_frequencies(self, y: ImageBatch, n):
        """Z = conj(D) o (Sy^T T),  T[p, x] = I2[p] Sx[p, x];  y (n, P): I2"""
        size = self.whole_groups(self.k_pad * self.n_rows), n
        self.rowscale(size, y=y.buffer, y_offset=y.offset)
        self.from_rows(n)
