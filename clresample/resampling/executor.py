"""What the executors of all geometries share: from a model to its frequencies and back.

    forward   Z = D o (Ty I1 Tx)           both axes to frequencies, then the transfer function
              aligned    I2 = Sy Z Sx
              affine     G = Sy twist(Z Sx),  I2 = gather(G) along each line
              distorted  I2[p] = sum_x (Sy Z)[p, x] Sx[p, x]
    adjoint   the same factors transposed, in reverse order

    I1 (Ny, Nx), I2 (My, Mx): one band of the model and of the observation
    Ty (ky, Ny), Tx (Nx, kx): cos and sin waves at the model's pixels; ky = 2 Hy, kx = 2 Hx
    Z (ky, kx): the frequencies; D o multiplies them by the transfer function, see contract.cl's MIX
    Sy, Sx: waves at the observed rows, columns, lines or pixels

All matrices are real: rows or columns 2i, 2i+1 are the cos and sin parts of frequency i.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from ..device.contraction import Contraction, ImageBatch, Matrix, padded
from ..device.tuning import Tuning


class Executor:
    """What the three executors share: the model's two axes and the transfer function.

    plans: one for all items of a batch, or one for each item; smaller ones are padded with zeros
    axes: the model axes taken as rows and columns of I1
    n_rows: rows of Sy, set by a subclass before it calls this __init__
    Subclasses add to scratch_shapes and bind, and implement observe and collect
    """

    n_rows: int

    def __init__(self, device, dtype, plans):
        self.device, self.dtype, self.plans = device, dtype, plans
        self.tuning = Tuning.of(device, dtype)
        first = plans[0]
        self.n_bands = first.n_bands
        self.axes = first.axes
        self.n_y, self.n_x = (first.mapping.shape_in[axis] for axis in self.axes)
        self.h_y, self.h_x = (max(len(p.nu[i]) for p in plans) for i in (0, 1))
        self.k_y, self.k_x = 2 * self.h_y, 2 * self.h_x
        self.k_pad = padded(self.k_x)
        self.in_y = self._table([p.in_y for p in plans], self.k_y, self.n_y)
        self.in_y_t = self._table([p.in_y.T for p in plans], self.n_y, self.k_y)
        self.in_x = self._table([p.in_x for p in plans], self.k_x, padded(self.n_x))
        self.in_x_t = self._table([p.in_x.T for p in plans], self.n_x, self.k_pad)
        self.out_y = self._table([p.out_y for p in plans], self.n_rows, self.k_y)
        self.out_y_t = self._table([p.out_y.T for p in plans], self.k_y, self.n_rows)
        shape = len(plans), self.n_bands, self.h_y, 4, self.k_pad // 2
        self.transfer = device.empty(shape, dtype)
        self.plain = Contraction(device, dtype)
        self.strided = Contraction(device, dtype, strided=self.axes != (0, 1))
        self.ragged = Contraction(device, dtype, ragged=True)
        self.mix = Contraction(device, dtype, epilogue="MIX")
        self.mix_adjoint = Contraction(device, dtype, epilogue="MIX", adjoint=True)
        self.n_reserved, self.scratch = 0, {}

    def apart(self) -> Executor:
        """An executor of the same tables on the device, with intermediates of its own: for callers
        that work between its stages. A shift of either is one of both."""
        other = copy.copy(self)
        other.n_reserved, other.scratch = 0, {}
        return other

    def scratch_shapes(self):
        """Intermediate matrices of one image: {name: (rows, elements of a row)}."""
        n_half = max(self.n_y, self.n_rows)
        return {"half": (n_half, self.k_pad), "frequencies": (self.k_y, self.k_pad)}

    def reserve(self, n_images):
        """Make room for the intermediates of `n_images` images at a time."""
        if self.n_reserved != n_images:
            self.n_reserved = 0  # until all is bound: an interruption leaves nothing half done
            self.scratch = {
                name: self.device.empty((n_images, rows, ld), self.dtype)
                for name, (rows, ld) in self.scratch_shapes().items()
            }
            self.bind()
            self.n_reserved = n_images

    def set_transfer(self, transfer):
        """Upload the transfer functions: a pair D(+,+), D(+,-) (C, Hy, Hx) for each plan."""
        host = np.zeros(self.transfer.shape, self.dtype)
        for item, (d_plus, d_minus) in zip(host, transfer, strict=True):
            planes = (d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)
            for i, plane in enumerate(planes):
                item[:, : plane.shape[1], i, : plane.shape[2]] = plane
        self.device.upload(host, self.transfer)

    def bind(self):
        """Bind the products of the model's end to the scratch that is there."""
        half, z = self.matrix("half", self.n_y), self.matrix("frequencies")
        model = ImageBatch.shaped(*self.plans[0].mapping.shape_in).matrix(self.axes)
        # `spread`: an image is transformed once for all bands
        once, shared = self.in_x_t._replace(div=1), half._replace(div=self.n_bands)
        self.in_columns, self.in_columns_once = (
            self.strided.bind(self.n_y, self.k_x, self.n_x, model, in_x_t, half)
            for in_x_t in (self.in_x_t, once)
        )
        self.in_rows, self.in_rows_shared = (
            self.to_frequencies(self.mix, self.n_y, self.in_y, right) for right in (half, shared)
        )
        self.back_rows = self.plain.bind(
            self.n_y, self.k_x, self.k_y, self.in_y_t, z, half, inward=False
        )
        self.back_columns = self.ragged.bind(
            self.n_y, self.n_x, self.k_x, half, self.in_x, model, inward=False
        )

    def forward(self, x: ImageBatch, y: ImageBatch, n, spread=False):
        """I2 from I1: x (n, Ny, Nx), or (n / n_bands, Ny, Nx) where `spread`, to y (n, My, Mx)."""
        self.analyse(x, n, spread)
        self.observe(y, n)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n, Ny, Nx)."""
        self.collect(y, n)
        self.synthesise(x, n)

    def observe(self, y: ImageBatch, n):
        """I2 of `n` images, y (n, My, Mx), from Z in scratch "frequencies"."""
        raise NotImplementedError

    def collect(self, y: ImageBatch, n):
        """The adjoint of `observe`, and conj(D) o of that: y (n, My, Mx) into the same scratch."""
        raise NotImplementedError

    def to_frequencies(self, mix: Contraction, k, left: Matrix, right: Matrix):
        """The product Z = D o (left right), left (ky, k), right (k, kx); `mix` may conjugate D."""
        z, d = self.matrix("frequencies"), self.tables(self.transfer)
        return mix.bind(self.k_y, self.k_x, k, left, right, z, d, self.n_bands)

    def analyse(self, x: ImageBatch, n, spread=False):
        """Z = D o (Ty I1 Tx) for `n` images, into scratch "frequencies".

        spread: the images are n / n_bands, each of which is seen in every band
        """
        if spread:
            self.in_columns_once(n // self.n_bands, a=x)
            self.in_rows_shared(n)
        else:
            self.in_columns(n, a=x)
            self.in_rows(n)

    def synthesise(self, x: ImageBatch, n):
        """I1 = Ty^T Z Tx^T of `n` images, Z in scratch "frequencies": the end of every adjoint."""
        self.back_rows(n)
        self.back_columns(n, c=x)

    def matrix(self, name, rows=None) -> Matrix:
        """Intermediate matrices, with all their rows or the first ones of each."""
        array = self.scratch[name]
        return Matrix(array.base_data, array.shape[2], (rows or array.shape[1]) * array.shape[2])

    def tables(self, array):
        """Tables (plans, bands, ...) of an epilogue as `Contraction.bind` takes them."""
        stride = math.prod(array.shape[1:]) if len(self.plans) > 1 else 0
        return array.base_data, stride, math.prod(array.shape[2:])

    def whole_groups(self, n):
        """`n` pixels of a line rounded up to whole groups of work-items."""
        return -(-n // self.tuning.line_group) * self.tuning.line_group

    def _table(self, tables, *shape) -> Matrix:
        """Host tables, one per plan, zero-padded to a common shape, on the device."""
        host = np.zeros((len(tables), *shape), self.dtype)
        for item, table in zip(host, tables, strict=True):
            item[tuple(slice(n) for n in table.shape)] = table
        stride = math.prod(shape) if len(tables) > 1 else 0
        return Matrix(self.device.put(host).base_data, shape[-1], stride, div=self.n_bands)
