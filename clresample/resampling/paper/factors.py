"""The two factors of the paper's scheme on the device, and the contraction that joins them.

    I2(i, l) = sum_u F^i(u) P^l(u),    F^i(u) = I1(i a + t - u),    P^l(u) = Pd(l b + u)

Both factors are band-limited, so that a sum over the pixels u of the padded grid is exact, and by
Parseval's theorem u may as well be a frequency: there a shift is a complex exponential, and the
inverse transform of every shifted image falls away.  The inner index stays as long as the padded
grid has pixels; it is worked off in slabs, so that a slab of F is read back from the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...device.contraction import Contraction, Matrix, padded
from .slabs import SHIFT_COST, SLAB_BYTES, SLAB_BYTES_OTHER, Slab

LANES = 8  # columns of one work-item in kernels/shift.cl


class Images(NamedTuple):
    """One band of consecutive items of a batch, item b at offset + b * stride [elements]."""

    buffer: object
    offset: int
    stride: int
    ld: int

    @classmethod
    def of(cls, array, start, band):
        """Band `band` of the items from `start` on of a device array (B, C, Ny, Nx)."""
        _, n_bands, n_y, n_x = array.shape
        offset = array.offset // array.dtype.itemsize + (start * n_bands + band) * n_y * n_x
        return cls(array.base_data, offset, n_bands * n_y * n_x, n_x)

    def matrix(self, axes) -> Matrix:
        """The images as matrices, transposed where `axes` is (1, 0)."""
        ld, step = (self.ld, 1) if axes == (0, 1) else (1, self.ld)
        return Matrix(self.buffer, ld, self.stride, step=step, offset=self.offset)


class Factors:
    """One association: steps i along observed axis `axis` shift the model, steps l the kernel.

    axes: model axes taken as rows and columns; n_y, n_x and k_y, k_x: their lengths, padded lengths
    n_units, unit_rows: the inner index, n_terms = n_units * unit_rows long
    z_rows: rows of the model's 2-D transform, if there is one
    Subclasses: name (of the kernels), model_axes, units, set_spectra, analyse, synthesise
    """

    def __init__(self, device, dtype, mapping, n_fft, axis):
        self.device, self.dtype, self.mapping = device, dtype, mapping
        self.axis, self.axes = axis, self.model_axes(mapping, axis)
        self.n_i, self.n_l = mapping.shape_out[axis], mapping.shape_out[1 - axis]
        steps = (mapping.shape_out[1], 1)
        self.step_i, self.step_l = steps[axis], steps[1 - axis]
        self.n_cols, self.l_pad = lanes(self.n_i), padded(self.n_l)
        self.n_y, self.n_x = (mapping.shape_in[k] for k in self.axes)
        self.k_y, self.k_x = (n_fft[k] for k in self.axes)
        self.h_y, self.h_x = (self.k_y + 1) // 2, (self.k_x + 1) // 2
        self.n_units, self.unit_rows, self.z_rows = self.units()
        self.n_terms = self.n_units * self.unit_rows
        self.cost = self.n_terms * padded(self.n_i) * (self.n_l + SHIFT_COST)

    def prepare(self):
        """Kernels and the model's transform on the device, and the slabs of the inner index."""
        device, dtype = self.device, self.dtype
        budget = SLAB_BYTES.get(device.kind, SLAB_BYTES_OTHER) // dtype.itemsize
        # half of the largest buffer: a slab may be a unit longer than the others
        n_slabs = max(
            -(-self.n_terms * self.n_cols // budget),
            -(-self.n_terms * self.l_pad * dtype.itemsize // (device.max_alloc // 2)),
        )
        n_slabs = min(n_slabs, self.n_units)
        ends = np.linspace(0, self.n_units, n_slabs + 1).astype(int)
        self.slabs = [Slab(*ends[i : i + 2], self.unit_rows) for i in range(n_slabs)]
        self.slab_rows = max(slab.n_rows for slab in self.slabs)
        self.group = max(1, budget // (self.slab_rows * self.n_cols))
        self.plain = Contraction(device, dtype)
        self.ragged = Contraction(device, dtype, ragged=True)
        self.first = Contraction(device, dtype, strided=self.axes != (0, 1))
        in_x = trigonometric(self.n_x, self.k_x)
        self.in_x, self.in_x_t = self._table(in_x), self._table(in_x.T)
        self.shift, self.unshift, self.collect, self.spread = (
            device.kernel("shift.cl", name, dtype=dtype)
            for name in (f"shift_{self.name}", f"unshift_{self.name}", "collect", "spread")
        )
        i, size = np.int32, np.uint64
        for kernel in (self.shift, self.unshift):
            kernel.set_scalar_arg_dtypes([i, i, i, None, i, i, None, None, None, i, i])
        for kernel in (self.collect, self.spread):
            kernel.set_scalar_arg_dtypes([i, i, i, None, None, None, size, i, i, i])
        self.covered = device.put(self.mapping.covered.astype(np.uint8))
        self.scratch = {}

    def reserve(self, n):
        """Make room for the intermediates of `n` images at a time."""
        if self.scratch.get("n") == n:
            return
        ld, n_chunks = padded(n * self.n_cols), sum(slab.n_chunks for slab in self.slabs)
        shapes = {
            "half": (n, self.n_y, self.in_x.ld),
            "spectra": (n, self.z_rows, self.in_x.ld),
            "shifted": (self.slab_rows, ld),
            "part": (n_chunks, self.n_l, ld),
        }
        self.scratch = {}  # frees the old ones first
        for name, shape in shapes.items():
            self.scratch[name] = self.device.zeros(shape, self.dtype)
        self.scratch["n"] = n

    def forward(self, x: Images, y: Images, band, n):
        """I2 of one band of `n` images."""
        z, f, part = self.analyse(x, n), self.scratch["shifted"], self.scratch["part"].base_data
        n_cols, i_chunk = n * self.n_cols, 0
        ld = padded(n_cols)
        for slab, (_, kernel) in zip(self.slabs, self.kernels[band], strict=True):
            self._shift(self.shift, slab, z, self.waves, f, self.n_cols, ld, n)
            self.plain(
                self.n_l,
                n_cols,
                slab.chunk,
                slab.n_chunks,
                Matrix(kernel.base_data, slab.n_rows, slab.chunk),
                Matrix(f.base_data, ld, slab.chunk * ld),
                Matrix(part, ld, self.n_l * ld, offset=i_chunk * self.n_l * ld),
            )
            i_chunk += slab.n_chunks
        self.collect.set_args(
            i_chunk,
            self.n_cols,
            ld,
            part,
            self.covered.base_data,
            y.buffer,
            y.offset,
            y.stride,
            self.step_l,
            self.step_i,
        )
        self.device.launch(self.collect, (self.n_i, self.n_l, n))

    def adjoint(self, y: Images, x: Images, band, n):
        """The adjoint of `forward`."""
        f, part = self.scratch["shifted"], self.scratch["part"].base_data
        z = self._scratch("spectra" if self.z_rows else "half")
        n_cols = n * self.n_cols
        ld = padded(n_cols)
        self.spread.set_args(
            n,
            self.n_i,
            self.n_cols,
            part,
            self.covered.base_data,
            y.buffer,
            y.offset,
            y.stride,
            self.step_l,
            self.step_i,
        )
        self.device.launch(self.spread, (ld, self.n_l))
        for slab, (kernel, _) in zip(self.slabs, self.kernels[band], strict=True):
            self.plain(
                slab.n_units * self.unit_rows,
                n_cols,
                self.n_l,
                1,
                Matrix(kernel.base_data, self.l_pad),
                Matrix(part, ld),
                Matrix(f.base_data, ld),
            )
            self._shift(self.unshift, slab, z, self.waves, f, self.n_cols, ld, n)
        self.synthesise(z, x, n)

    def _columns(self, x: Images, n) -> Matrix:
        """The model transformed along its rows: sums with cos and sin (n, n_y, 2 h_x)."""
        half = self._scratch("half")
        self.first(self.n_y, 2 * self.h_x, self.n_x, n, x.matrix(self.axes), self.in_x, half)
        return half

    def _from_columns(self, half, x: Images, n):
        self.ragged(self.n_y, self.n_x, 2 * self.h_x, n, half, self.in_x_t, x.matrix(self.axes))

    def _shift(self, kernel, slab, z: Matrix, waves, f, n_cols, ld, n):
        kernel.set_args(
            self.h_x,
            slab.n_units,
            slab.first,
            z.buffer,
            z.stride,
            z.ld,
            *waves,
            f.base_data,
            n_cols,
            ld,
        )
        size = (self.h_x, slab.n_units * n)
        self.device.launch(kernel, size if kernel is self.unshift else (n_cols // LANES, *size))

    def _new_kernel(self, slab):
        return self.device.zeros((slab.n_rows, self.l_pad), self.dtype)

    def _both_ways(self, kernel):
        """A kernel's factor (rows, l) and its transpose: either is read along its rows."""
        host = self.device.get(kernel)[:, : self.n_l]
        return kernel, self.device.put(np.ascontiguousarray(host.T))

    def _scratch(self, name) -> Matrix:
        array = self.scratch[name]
        return Matrix(array.base_data, array.shape[2], array.shape[1] * array.shape[2])

    def _table(self, host) -> Matrix:
        """A matrix, its rows padded with zeros; one for each band where `host` has three axes."""
        full = np.zeros((*host.shape[:-1], padded(host.shape[-1])), self.dtype)
        full[..., : host.shape[-1]] = host
        stride = full.shape[-2] * full.shape[-1] if host.ndim > 2 else 0
        return Matrix(self.device.put(full).base_data, full.shape[-1], stride)

    def _wave(self, k, x):
        """exp(2 pi i nu x), nu = 0 ... (k-1)/2k: planes cos, sin (h, 2, len(x) to whole lanes)."""
        cycles = np.multiply.outer(np.arange((k + 1) // 2) / k, x)
        angle = 2 * np.pi * (cycles - np.rint(cycles))
        host = np.zeros((len(angle), 2, lanes(len(x))), self.dtype)
        host[:, 0, : len(x)], host[:, 1, : len(x)] = np.cos(angle), np.sin(angle)
        return self.device.put(host).base_data


def lanes(n: int) -> int:
    """`n` columns rounded up to whole work-items."""
    return -(-n // LANES) * LANES


def trigonometric(n, k):
    """cos and sin of 2 pi kappa x / k in columns 2 kappa, 2 kappa + 1, for x = 0 ... n - 1."""
    angle = 2 * np.pi / k * (np.arange(n)[:, None] * np.arange((k + 1) // 2) % k)
    return np.stack([np.cos(angle), np.sin(angle)], axis=2).reshape(n, -1)
