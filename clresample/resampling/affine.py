"""Executor of any affine mapping: lines through the model, interpolated along each."""

from __future__ import annotations

import numpy as np

from ..device.contraction import Contraction, Matrix, padded
from .executor import GROUP, Executor, Images, whole_groups


class AffineExecutor(Executor):
    """Any affine mapping in two passes: columns of the model to lines, then along each line."""

    def __init__(self, device, dtype, plans):
        self.by_row = plans[0].lines.by_row
        n_rows, n_steps = plans[0].mapping.shape_out
        self.n_rows, self.n_steps = (n_rows, n_steps) if self.by_row else (n_steps, n_rows)
        self.n_columns = max(p.out_x.shape[1] for p in plans)
        self.n_pad = padded(self.n_columns)
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.k_x, self.n_pad)
        self.out_x_t = self._table([p.out_x.T for p in plans], self.n_columns, self.k_pad)
        turns = [np.stack([np.cos(p.twist), np.sin(p.twist)], axis=1) for p in plans]
        self.turn = self._table(turns, self.h_y, 2, self.n_pad)
        self.twist = Contraction(device, dtype, epilogue="TWIST")
        self.twist_adjoint = Contraction(device, dtype, epilogue="TWIST", adjoint=True)
        lines = [p.lines for p in plans]
        self.to_pixels = Gather(
            self, [p.start for p in lines], [p.weight for p in lines], self.n_columns, self.n_steps
        )
        self.to_columns = Gather(
            self, [p.start_t for p in lines], [p.weight_t for p in lines], self.n_steps, self.n_pad
        )

    def scratch_shapes(self):
        return super().scratch_shapes() | {
            "turned": (self.k_y, self.n_pad),
            "lines": (self.n_rows, self.n_pad),
        }

    def forward(self, x: Images, y: Images, n, spread=False):
        self.analyse(x, n, spread)
        z, turned, g = (self._scratch(name) for name in ("spectrum", "turned", "lines"))
        self.twist(
            self.k_y, self.n_columns, self.k_x, n, z, self.out_x, turned, self._turn(), self.n_bands
        )
        self.plain(self.n_rows, self.n_columns, self.k_y, n, self.out_y, turned, g)
        self.to_pixels(g, self._lines_of(y), n)

    def adjoint(self, y: Images, x: Images, n):
        turned, g = self._scratch("turned"), self._scratch("lines")
        self.to_columns(self._lines_of(y), g, n)
        self.twist_adjoint(
            self.k_y,
            self.n_columns,
            self.n_rows,
            n,
            self.out_y_t,
            g,
            turned,
            self._turn(),
            self.n_bands,
        )
        self.to_spectrum(self.mix_adjoint, self.n_columns, turned, self.out_x_t, n)
        self.synthesise(x, n)

    def _turn(self):
        return self.turn.buffer, self.turn.stride, 0

    def _lines_of(self, y: Images) -> Matrix:
        return y.matrix((0, 1) if self.by_row else (1, 0))


class Gather:
    """Sparse sums along lines, out[l, p] = sum_t weight[l, t, p] in[l, start[l, p] + t].

    starts, weights: one for each plan; n_in, n_out: elements of a line on either side
    """

    def __init__(self, path: Executor, starts, weights, n_in, n_out):
        self.device, self.n_rows, self.n_out = path.device, path.n_rows, n_out
        self.n_bands, self.n_plans = path.n_bands, len(path.plans)
        n_taps = max(w.shape[1] for w in weights)
        n_lines = path.n_rows
        start = np.zeros((len(starts), n_lines, n_out), np.int32)
        weight = np.zeros((len(starts), n_lines, n_taps, n_out), path.dtype)
        for i, (s, w) in enumerate(zip(starts, weights, strict=True)):
            # with more taps than its own, a plan's last ones would read beyond the line
            back = np.maximum(s - (n_in - n_taps), 0)
            taps = back[:, None] + np.arange(w.shape[1])[:, None]
            start[i, :, : s.shape[1]] = s - back
            np.put_along_axis(weight[i, :, :, : w.shape[2]], taps, w, axis=1)
        self.start, self.weight = path.device.put(start), path.device.put(weight)
        self.kernel = path.device.kernel("warp.cl", "gather", dtype=path.dtype, N_TAPS=n_taps)
        i, size = np.int32, np.uint64
        self.kernel.set_scalar_arg_dtypes(
            [i, i, i, i, None, size, i, i, i, None, size, i, i, i, None, None]
        )

    def __call__(self, source: Matrix, target: Matrix, n):
        self.kernel.set_args(
            self.n_out,
            self.n_rows,
            self.n_bands,
            self.n_plans,
            source.buffer,
            source.offset,
            source.stride,
            source.ld,
            source.step,
            target.buffer,
            target.offset,
            target.stride,
            target.ld,
            target.step,
            self.start.base_data,
            self.weight.base_data,
        )
        self.device.launch(self.kernel, (whole_groups(self.n_out), self.n_rows, n), (GROUP, 1, 1))
