"""Executor of any affine mapping: lines through the model, interpolated along each."""

from __future__ import annotations

import numpy as np

from ..device.contraction import ImageBatch, MatrixBatch, row_stride
from ..device.rounding import round_up
from .executor import Executor


class AffineExecutor(Executor):
    """Any affine mapping in two passes: columns of the model to lines, then along each line.

    Observed rows, or columns, are L lines through the model; J equidistant columns cross them.
    Sx (kx, J): waves at the columns
    Sy (L, ky): waves where the lines cross the model's middle column, relative to the middle line
    twist: multiplies column frequencies by the conjugate of waves (Hy, J), which shears the lines
    gather: from the J columns of a line to its observed pixels; see LineTaps
    """

    def __init__(self, device, dtype, plans):
        self.by_row = plans[0].lines.by_row
        n_rows, n_steps = self.shape_out = plans[0].mapping.shape_out
        self.n_rows, self.n_steps = (n_rows, n_steps) if self.by_row else (n_steps, n_rows)
        self._columns = np.array([p.out_x.shape[1] for p in plans])
        self.n_columns = int(self._columns.max())
        self.n_pad = row_stride(self.n_columns)
        super().__init__(device, dtype, plans)
        self.out_x = self._table([p.out_x for p in plans], self.k_x, self.n_pad)
        turns = [np.stack([p.twist.real, p.twist.imag], axis=1) for p in plans]
        self.turn = self._table(turns, self.h_y, 2, self.n_pad)
        lines = [p.lines for p in plans]
        self.to_pixels = LineInterpolation(
            self, [p.start for p in lines], [p.weight for p in lines], self.n_columns, self.n_steps
        )

    def scratch_shapes(self):
        return super().scratch_shapes() | {
            "turned": (self.k_y, self.n_pad),
            "lines": (self.n_rows, self.n_pad),
        }

    def bind(self):
        super().bind()
        n_y, n_x, turn = self.n_rows, self.n_columns, (self.turn.buffer, self.turn.stride, 0)
        z, turned, lines = (self.matrix(name) for name in ("frequencies", "turned", "lines"))
        k_y, k_x, j, n = self.k_ys, self.k_xs, self._columns, self.n_bands
        self.to_columns = self.product(epilogue="TWIST").bind(
            *(self.k_y, n_x, self.k_x),
            *(z, self.out_x, turned, turn),
            n,
            inward=False,
            own=self.item_sizes(m=k_y, n=j, k=k_x),
        )
        self.to_lines = self.waves("out_y", "left", back=True).bind(
            *(n_y, n_x, self.k_y),
            *(self.out_y, turned, lines),
            n_bands=n,
            inward=False,
            own=self.item_sizes(n=j, k=k_y),
        )

    def bind_adjoint(self):
        super().bind_adjoint()
        n_y, n_x, turn = self.n_rows, self.n_columns, (self.turn.buffer, self.turn.stride, 0)
        turned, lines = self.matrix("turned"), self.matrix("lines")
        k_y, j, n = self.k_ys, self._columns, self.n_bands
        out_y_t = self.cached("out_y_t", lambda: self._transposed("out_y", self.k_y, n_y))
        out_x_t = self.cached("out_x_t", lambda: self._transposed("out_x", n_x, self.k_pad))
        self.from_pixels = self.cached("from_pixels", self._gather_back)
        twist = self.waves("out_y", "left", epilogue="TWIST", adjoint=True)
        self.from_lines = twist.bind(
            *(self.k_y, n_x, n_y),
            *(out_y_t, lines, turned, turn),
            n,
            own=self.item_sizes(m=k_y, n=j),
        )
        product = self.product(**self.adjoint_options())
        self.from_columns = self.to_frequencies(product, n_x, turned, out_x_t, j)

    def _gather_back(self):
        lines = [p.lines for p in self.plans]
        tables = [p.start_t for p in lines], [p.weight_t for p in lines]
        return LineInterpolation(self, *tables, self.n_steps, self.n_pad)

    def frequencies_to_pixels(self, y: ImageBatch, n):
        """I2 = gather(G),  G = Sy twist(Z Sx).

        G (n, L, J): the lines at equidistant columns
        y (n, My, Mx): the observation I2 of each band, overwritten
        """
        self.to_columns(n)
        self.to_lines(n)
        self.to_pixels(self.matrix("lines"), self._lines_of(y), n, self.which)

    def pixels_to_frequencies(self, y: ImageBatch, n):
        """Z = conj(D) o (twist^T(Sy^T G) Sx^T),  G = gather^T(I2);  y (n, My, Mx): I2"""
        self.from_pixels(self._lines_of(y), self.matrix("lines"), n, self.which)
        self.from_lines(n)
        self.from_columns(n)

    def _lines_of(self, y: ImageBatch) -> MatrixBatch:
        return y.matrix((0, 1) if self.by_row else (1, 0))


def kept_taps(n_taps, n_in, tuning):
    """Number of taps kept of each sum of n_taps along a line of n_in elements.

    If a work-item loops over a line, a multiple of four, unless the line is shorter.
    """
    return min(round_up(n_taps, 4), n_in) if tuning.row_loops else n_taps


class LineInterpolation:
    """Sparse sums along lines, out[l, p] = sum_t weight[l, t, p] in[l, start[l, p] + t].

    starts, weights: one (L, P), (L, taps, P) for each plan; n_in, n_out: elements of a line on
        either side, at least those of any plan
    """

    def __init__(self, executor: Executor, starts, weights, n_in, n_out):
        device, tuning, by_pixel = executor.device, executor.tuning, executor.tuning.row_loops
        n_lines = executor.n_rows
        n_taps = kept_taps(max(w.shape[1] for w in weights), n_in, tuning)
        start = np.zeros((len(starts), n_lines, n_out), np.int32)
        shape = (n_out, n_taps) if by_pixel else (n_taps, n_out)
        weight = np.zeros((len(starts), n_lines, *shape), executor.dtype)
        by_tap = weight.swapaxes(2, 3) if by_pixel else weight
        for i, (s, w) in enumerate(zip(starts, weights, strict=True)):
            taps = np.arange(w.shape[1])
            by_tap[i, :, : len(taps), : w.shape[2]] = w
            # a plan with fewer taps than this number would read beyond the line at its end
            back = np.maximum(s - (n_in - n_taps), 0)
            start[i, :, : s.shape[1]] = s - back
            line, at = np.nonzero(back)
            by_tap[i, line, :, at] = 0
            later = back[line, at, None] + taps
            by_tap[i, line[:, None], later, at[:, None]] = w[line, :, at]
        self.launch = device.launcher(
            "warp.cl",
            "gather",
            dtype=executor.dtype,
            local_size=(1, 1, 1) if tuning.row_loops else (tuning.line_group, 1, 1),
            N_TAPS=n_taps,
            ROWS=tuning.row_loops,
        ).bind(
            n_out=n_out,
            n_lines=n_lines,
            n_bands=executor.n_bands,
            n_tables=len(executor.plans),
            start=device.put(start),
            weight=device.put(weight),
        )
        # a work-item that loops over a line does so for all bands of a scene
        self.bands_each = executor.n_bands if tuning.row_loops else 1
        self.size = 1 if tuning.row_loops else executor.whole_groups(n_out), n_lines

    def __call__(self, source: MatrixBatch, target: MatrixBatch, n, which):
        """Queues the sums of `n` images, all bands of some scenes: rows of source to target.

        which: the executor's
        """
        self.launch(
            (*self.size, n // self.bands_each),
            which=which,
            source=source.buffer,
            source_offset=source.offset,
            source_stride=source.stride,
            source_ld=source.ld,
            source_step=source.step,
            target=target.buffer,
            target_offset=target.offset,
            target_stride=target.stride,
            target_ld=target.ld,
            target_step=target.step,
        )
