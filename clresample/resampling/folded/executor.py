"""The chain of aligned geometries in float64 between float32 images, at float32's cost.

A product in float64 takes a CPU twice as long. Images in parts even and odd about their middles
need half of the products, since a cos meets even parts alone and a sin odd ones; so a float32
operator rounds its input and its output and nothing between. In float32 throughout, tables,
intermediates and sums round some ten times more: 1e-7 of an image, more than what pixels cost.

    forward   Z = D o (Ty fold(I1) Tx),   I2 = unfold(Sy Z Sx),   each of the four parts by itself
    adjoint   the same factors transposed, in reverse order

D holds the observation's middle as a shift, so both sides have waves about their own middles.
"""

from __future__ import annotations

import numpy as np

from ...device.contraction import Contraction, ImageBatch, Matrix
from ..executor import OnDevice
from ..plan import Plan
from ..tables import waves

# Columns of tables are padded to a multiple of this, or to whole vectors if those are wider.
PAD = 8


class FoldedExecutor(OnDevice):
    """Forward and adjoint of one aligned Plan without terms; all inside it is float64.

    Images in and out are float32. `serves` says for which operators it is the better one.
    """

    def __init__(self, device, plan: Plan):
        super().__init__(device, np.float64, [plan])
        self.pad = max(PAD, self.tuning.tile["VW"])
        self.n_frequencies = len(plan.nu[0]), len(plan.nu[1])
        self.h_pad = -(-self.n_frequencies[1] // self.pad) * self.pad
        self.plain = Contraction(device, self.dtype)
        mapping, axes = plan.mapping, plan.axes
        shape = tuple(mapping.shape_in[axis] for axis in axes)
        rates = tuple(mapping.matrix[axes[i], i] for i in (0, 1))
        lit = [mapping.covered.any(axis=1 - i) for i in (0, 1)]
        self.model = Side(self, "model", shape, (1.0, 1.0), [np.ones(n) for n in shape], axes)
        self.observed = Side(self, "observed", mapping.shape_out, rates, lit, (0, 1))
        middle_out, middle_in = (
            (np.array(n) - 1) / 2 for n in (mapping.shape_out, mapping.shape_in)
        )
        self.middle = mapping.matrix @ middle_out + mapping.offset - middle_in
        h_y = self.n_frequencies[0]
        self.transfer = device.empty((self.n_bands, h_y, 4, self.h_pad), self.dtype)
        self.mix, self.mix_adjoint = (
            self.launcher("multiply", SIGN=sign).bind(
                h_y=h_y, h_pad=self.h_pad, n_bands=self.n_bands, D=self.transfer
            )
            for sign in (1, -1)
        )

    @staticmethod
    def serves(device, dtype, plans) -> bool:
        """Whether it is as fast as float32 there and rounds less: on CPUs with float64."""
        cpu = device.kind == "CPU" and not device.simulated and device.has_fp64
        plain = len(plans) == 1 and plans[0].n_terms == 1 and plans[0].geometry == "aligned"
        return cpu and plain and np.dtype(dtype) == np.float32

    def launcher(self, name, **macros):
        """A kernel of fold.cl."""
        return self.device.launcher(
            "fold.cl",
            name,
            dtype=self.dtype,
            local_size=self.tuning.local_size(3),
            ROWS=self.tuning.row_loops,
            **macros,
        )

    def set_shift(self, shift):
        """Upload D with every observed pixel moved by `shift` (2,) [model px]."""
        host = np.zeros(self.transfer.shape, self.dtype)
        d_plus, d_minus = self.plans[0].shifted(shift + self.middle)
        for i, plane in enumerate((d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)):
            host[:, :, i, : plane.shape[2]] = plane
        self.device.upload(host, self.transfer)

    def scratch_shapes(self):
        shapes = {"frequencies": (2 * self.n_frequencies[0], 2 * self.h_pad)}
        return shapes | self.model.scratch_shapes() | self.observed.scratch_shapes()

    def bind(self):
        self.model.bind(self.scratch)
        self.observed.bind(self.scratch)
        for mix in (self.mix, self.mix_adjoint):
            mix.bind(z=self.scratch["frequencies"])

    def forward(self, x: ImageBatch, y: ImageBatch, n):
        """I2 from I1: x (n, Ny, Nx) to y (n, My, Mx), both float32."""
        self.model.analyse(x, n)
        self.mix((1, self.n_frequencies[0], n), n=n)
        self.observed.synthesise(y, n)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n, Ny, Nx)."""
        self.observed.analyse(y, n)
        self.mix_adjoint((1, self.n_frequencies[0], n), n=n)
        self.model.synthesise(x, n)


class Side:
    """The images of one end of the operator, and waves about their middle.

    folded: the executor; name: of its intermediates
    shape (2,) [px]: along the tables' axes, which are the images' `axes`
    rates (2,) [model px / px]: from a pixel to the next; lit (2 arrays): 1 of rows and columns that
        count, else 0
    """

    def __init__(self, folded: FoldedExecutor, name, shape, rates, lit, axes):
        self._folded, self._name, self._axes = folded, name, axes
        device = folded.device
        half = [(n + 1) // 2 for n in shape]
        self._half, self._n_pad = half, -(-half[1] // folded.pad) * folded.pad
        off = [np.arange(m) + (0.0 if n % 2 else 0.5) for m, n in zip(half, shape)]
        along_y, along_x = (waves(folded.plans[0].nu[i], rates[i] * off[i]) for i in (0, 1))
        y, x = (np.stack([w[:, 0::2], w[:, 1::2]]) for w in (along_y, along_x))  # cos, sin
        self._to_y, self._from_y = (
            device.put(np.ascontiguousarray(w)) for w in (y.swapaxes(1, 2), y)
        )
        self._to_x = [device.put(_padded(w, folded.h_pad)) for w in x]
        self._from_x = [device.put(_padded(w.T, self._n_pad)) for w in x]
        weights = [device.put(_weights(n, m, on)) for n, m, on in zip(shape, half, lit)]
        self._fold, self._unfold = (
            folded.launcher(kernel, STRIDED=axes != (0, 1)).bind(
                n_y=shape[0],
                n_x=shape[1],
                n_pad=self._n_pad,
                weight_y=weights[0],
                weight_x=weights[1],
            )
            for kernel in ("fold", "unfold")
        )

    def scratch_shapes(self):
        """Intermediates of one image: its parts even and odd along x, and their spectra along x."""
        half_y, n_pad = self._half[0], self._n_pad
        parts = {f"{self._name} {part}": (2 * half_y, n_pad) for part in ("even", "odd")}
        return parts | {f"{self._name} half": (2 * half_y, 2 * self._folded.h_pad)}

    def bind(self, scratch):
        """Bind kernels and products to the intermediates that are there."""
        folded, (half_y, half_x), n_pad = self._folded, self._half, self._n_pad
        (h_y, h_x), h_pad, plain = folded.n_frequencies, folded.h_pad, folded.plain
        parts = [scratch[f"{self._name} {part}"] for part in ("even", "odd")]
        for kernel in (self._fold, self._unfold):
            kernel.bind(even=parts[0], odd=parts[1])
        half = Matrix(scratch[f"{self._name} half"].base_data, 2 * h_pad, half_y * 2 * h_pad)
        z = Matrix(scratch["frequencies"].base_data, 2 * h_pad, h_y * 2 * h_pad)
        # of the even and of the odd part along x, whose spectra lie side by side
        self._to_columns, self._from_columns = [], []
        for i, part in enumerate(parts):
            image, spectrum = (
                Matrix(part.base_data, n_pad, half_y * n_pad),
                half._replace(offset=i * h_pad),
            )
            to_x, from_x = self._to_x[i].base_data, self._from_x[i].base_data
            self._to_columns.append(
                plain.bind(half_y, h_x, half_x, image, Matrix(to_x, h_pad), spectrum, inward=False)
            )
            self._from_columns.append(
                plain.bind(
                    half_y, half_x, h_x, spectrum, Matrix(from_x, n_pad), image, inward=False
                )
            )
        to_y = Matrix(self._to_y.base_data, half_y, h_y * half_y)
        from_y = Matrix(self._from_y.base_data, h_y, half_y * h_y)
        self._to_rows = plain.bind(h_y, 2 * h_pad, half_y, to_y, half, z, inward=False)
        self._from_rows = plain.bind(half_y, 2 * h_pad, h_y, from_y, z, half, inward=False)

    def analyse(self, images: ImageBatch, n):
        """Scratch "frequencies" from `n` images."""
        self._queue(self._fold, images, n)
        for product in self._to_columns:
            product(2 * n)
        self._to_rows(2 * n, div_a=n)

    def synthesise(self, images: ImageBatch, n):
        """`n` images from scratch "frequencies": the transpose of `analyse`."""
        self._from_rows(2 * n, div_a=n)
        for product in self._from_columns:
            product(2 * n)
        self._queue(self._unfold, images, n)

    def _queue(self, kernel, images: ImageBatch, n):
        at = images.matrix(self._axes)
        kernel(
            (1, self._half[0], n),
            n=n,
            images=at.buffer,
            offset=at.offset,
            stride=at.stride,
            ld=at.ld,
            step=at.step,
        )


def _weights(n, n_half, lit):
    """Weights (2, n_half) of the pixels after the middle of `n` and of their partners before it."""
    lit = np.asarray(lit, float)
    after, before = lit[n // 2 :], lit[:n_half][::-1].copy()
    before[0] *= 1 - n % 2  # a middle pixel has no partner
    return np.stack([after, before])


def _padded(table, n):
    """A table with its rows zero-padded to `n` columns."""
    return np.pad(table, ((0, 0), (0, n - table.shape[1])))
