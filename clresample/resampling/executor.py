"""What the executors of all geometries share: from a model to its frequencies and back.

    forward   Z = D o (Ty I1 Tx)           both axes to frequencies, then the transfer function
              aligned    I2 = Sy Z Sx
              affine     G = Sy twist(Z Sx),  I2 = gather(G) along each line
              distorted  I2[p] = sum_x (Sy Z)[p, x] Sx[p, x]
    adjoint   the same factors transposed, in reverse order

Where a band adds up T images of the model, one through each PSF of a basis, Z = sum_t Z_t with
Z_t = D_t o (Ty I1_t Tx): what follows is done once (Terms).

    I1 (Ny, Nx), I2 (My, Mx): one band of the model and of the observation
    Ty (ky, Ny), Tx (Nx, kx): cos and sin waves at the model's pixels; ky = 2 Hy, kx = 2 Hx
    Z (ky, kx): the frequencies; D o multiplies them by the transfer function, see contract.cl's MIX
    Sy, Sx: waves at the observed rows, columns, lines or pixels

All matrices are real: rows or columns 2i, 2i+1 are the cos and sin parts of frequency i.
"""

from __future__ import annotations

import copy
import math
from typing import Self

import numpy as np

from ..device.contraction import Contraction, ImageBatch, Matrix, Own, padded
from ..device.tuning import Tuning


class OnDevice:
    """An executor's memory on the device: tables, and intermediates of as many images as asked for.

    device, dtype, tuning, plans, n_bands: of the executor
    n_reserved: images that there is room for; scratch: the intermediates, by their names
    which (items,): int32, on the device: the plan of each item; None where all are seen alike
    Subclasses implement scratch_shapes, bind and bind_back
    """

    def __init__(self, device, dtype, plans):
        self.device, self.dtype, self.plans = device, dtype, plans
        self.tuning, self.n_bands = Tuning.of(device, dtype), plans[0].n_bands
        self.n_reserved, self.scratch = 0, {}
        self.which = None
        self._made = {}  # what only the adjoint reads, once it is asked for
        self._bound_back = False

    def scratch_shapes(self):
        """Intermediate matrices of one image: {name: (rows, elements of a row)}."""
        raise NotImplementedError

    def bind(self):
        """Bind the products to the scratch that is there, those of the way forward at least."""
        raise NotImplementedError

    def bind_back(self):
        """Bind those of the adjoint, which many callers never ask for."""

    def way_back(self):
        """See that the products of the adjoint are bound."""
        if not self._bound_back:
            self.bind_back()
            self._bound_back = True

    def follow(self, which):
        """Have the next items seen by these plans (items,), of `which` made as large as that."""
        self.device.upload(np.ascontiguousarray(which, np.int32), self.which[: len(which)])

    def made(self, name, make):
        """What `make()` gives, made once for this executor and those `apart` from it."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    def apart(self) -> Self:
        """An executor of the same tables on the device, with intermediates of its own: for callers
        that work between its stages. A shift of either is one of both."""
        other = copy.copy(self)
        other.n_reserved, other.scratch, other._bound_back = 0, {}, False
        return other

    def reserve(self, n_images):
        """Make room for the intermediates of `n_images` images at a time."""
        if self.n_reserved != n_images:
            # until all is bound: an interruption leaves nothing half done
            self.n_reserved, self._bound_back = 0, False
            # items of their own sizes leave the rest as it is, which sums may meet with weight 0
            make = self.device.empty if self.which is None else self.device.zeros
            self.scratch = {
                name: make((n_images, rows, ld), self.dtype)
                for name, (rows, ld) in self.scratch_shapes().items()
            }
            self.bind()
            self.n_reserved = n_images

    def matrix(self, name, rows=None) -> Matrix:
        """Intermediate matrices, with all their rows or the first ones of each."""
        array = self.scratch[name]
        return Matrix(array.base_data, array.shape[2], (rows or array.shape[1]) * array.shape[2])

    def tables(self, array):
        """Tables (plans or items, bands, ...) of an epilogue as `Contraction.bind` takes them."""
        stride = math.prod(array.shape[1:]) if len(array) > 1 else 0
        return array.base_data, stride, math.prod(array.shape[2:])

    def whole_groups(self, n):
        """`n` pixels of a line rounded up to whole groups of work-items."""
        return -(-n // self.tuning.line_group) * self.tuning.line_group

    def own(self, **sizes) -> Own | None:
        """The Own of products with these sizes of each plan; None where all items share them."""
        return None if self.which is None else Own(self.which, **sizes)

    def _table(self, tables, *shape) -> Matrix:
        """Host tables, one per plan, zero-padded to a common shape, on the device."""
        host = np.zeros((len(tables), *shape), self.dtype)
        for item, table in zip(host, tables, strict=True):
            item[tuple(slice(n) for n in table.shape)] = table
        stride = math.prod(shape) if len(tables) > 1 else 0
        table = self.device.put(host).base_data
        return Matrix(table, shape[-1], stride, div=self.n_bands, own=len(tables) > 1)


class Executor(OnDevice):
    """What the three executors share: the model's two axes and the transfer function.

    plans: one for all items of a batch, or one for each item; smaller ones are padded with zeros
    axes: the model axes taken as rows and columns of I1
    n_rows: rows of Sy, set by a subclass before it calls this __init__
    k_ys, k_xs (plans,): ky and kx of each plan, of which k_y and k_x are the largest
    Subclasses add to scratch_shapes and bind, and implement observe and collect
    """

    n_rows: int
    bounded = True  # whether products of an item end where the tables of its plan do

    def __init__(self, device, dtype, plans):
        super().__init__(device, dtype, plans)
        first = plans[0]
        self.n_terms, self.axes = first.n_terms, first.axes
        self.n_y, self.n_x = (first.mapping.shape_in[axis] for axis in self.axes)
        self.h_y, self.h_x = (max(len(p.nu[i]) for p in plans) for i in (0, 1))
        self.k_y, self.k_x = 2 * self.h_y, 2 * self.h_x
        self.k_pad = padded(self.k_x)
        self.k_ys, self.k_xs = np.array([[self.k_y, self.k_x]] * len(plans)).T
        if self.bounded and len(plans) > 1:
            self.k_ys, self.k_xs = 2 * np.array([[len(nu) for nu in p.nu] for p in plans]).T
            self.which = device.put(np.arange(len(plans)), np.int32)
        self.in_y = self._table([p.in_y for p in plans], self.k_y, self.n_y)
        self.in_x_t = self._table([p.in_x.T for p in plans], self.n_x, self.k_pad)
        self.out_y = self._table([p.out_y for p in plans], self.n_rows, self.k_y)
        shape = len(plans), self.n_bands * self.n_terms, self.h_y, 4, self.k_pad // 2
        self.transfer = device.empty(shape, dtype)
        self.terms = Terms(self) if self.n_terms > 1 else None
        self.plain = Contraction(device, dtype)
        self.strided = Contraction(device, dtype, strided=self.axes != (0, 1))
        self.ragged = Contraction(device, dtype, ragged=True)
        self.mix = Contraction(device, dtype, epilogue="MIX")
        self.mix_adjoint = Contraction(device, dtype, epilogue="MIX", adjoint=True)

    @property
    def in_y_t(self) -> Matrix:
        """Ty^T of the adjoint."""
        return self.made("in_y_t", lambda: self._transposed("in_y", self.n_y, self.k_y))

    @property
    def in_x(self) -> Matrix:
        """Tx^T of the adjoint."""
        shape, plans = (self.k_x, padded(self.n_x)), self.plans
        return self.made("in_x", lambda: self._table([p.in_x for p in plans], *shape))

    def _transposed(self, name, *shape):
        """Tables of all plans on the device, transposed."""
        return self._table([getattr(plan, name).T for plan in self.plans], *shape)

    def apart(self) -> Self:
        other = super().apart()
        other.terms = Terms(other) if self.terms else None
        return other

    def scratch_shapes(self):
        n_half = max(self.n_terms * self.n_y, self.n_rows)
        shapes = {"half": (n_half, self.k_pad), "frequencies": (self.k_y, self.k_pad)}
        return shapes | ({"terms": (self.n_terms * self.k_y, self.k_pad)} if self.terms else {})

    @property
    def model_frequencies(self):
        """The scratch of Z, (n, ky, k_pad), or of the T parts Z_t of each, (n T, ky, k_pad)."""
        return self.scratch["terms" if self.terms else "frequencies"]

    def set_transfer(self, transfer):
        """Upload the transfer functions: a pair D(+,+), D(+,-) (C, Hy, Hx) for each plan; of a
        batch that one plan serves, for each item, from before `apart` and `reserve` on."""
        if len(transfer) != len(self.transfer):
            self.transfer = self.device.empty((len(transfer), *self.transfer.shape[1:]), self.dtype)
        host = np.zeros(self.transfer.shape, self.dtype)
        for item, (d_plus, d_minus) in zip(host, transfer, strict=True):
            planes = (d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)
            for i, plane in enumerate(planes):
                item[:, : plane.shape[1], i, : plane.shape[2]] = plane
        self.device.upload(host, self.transfer)

    def bind(self):
        """Bind the products of the model's end to the scratch that is there."""
        half, n = self.matrix("half", self.n_y), self.n_bands * self.n_terms
        z = self.matrix("terms" if self.terms else "frequencies", self.k_y)
        model = ImageBatch.shaped(*self.plans[0].mapping.shape_in).matrix(self.axes)
        # `spread`: an image is transformed once for all bands
        once, shared = self.in_x_t._replace(div=1), half._replace(div=n)
        k_y, k_x = self.k_ys, self.k_xs
        self.in_columns, self.in_columns_once = (
            self.strided.bind(
                *(self.n_y, self.k_x, self.n_x),
                *(model, in_x_t, half),
                n_bands=in_x_t.div,
                own=self.own(n=k_x),
            )
            for in_x_t in (self.in_x_t._replace(div=n), once)
        )
        d, in_y, own = self.tables(self.transfer), self.in_y._replace(div=n), self.own(m=k_y, n=k_x)
        self.in_rows, self.in_rows_shared = (
            self.mix.bind(self.k_y, self.k_x, self.n_y, in_y, right, z, d, n, own=own)
            for right in (half, shared)
        )
        if self.terms:
            self.terms.bind(self.scratch)

    def bind_back(self):
        """Bind those of the adjoint."""
        half, n = self.matrix("half", self.n_y), self.n_bands * self.n_terms
        z = self.matrix("terms" if self.terms else "frequencies", self.k_y)
        model = ImageBatch.shaped(*self.plans[0].mapping.shape_in).matrix(self.axes)
        k_y, k_x = self.k_ys, self.k_xs
        in_y_t, in_x = self.in_y_t._replace(div=n), self.in_x._replace(div=n)
        self.back_rows = self.plain.bind(
            *(self.n_y, self.k_x, self.k_y),
            *(in_y_t, z, half),
            n_bands=n,
            inward=False,
            own=self.own(n=k_x, k=k_y),
        )
        self.back_columns = self.ragged.bind(
            *(self.n_y, self.n_x, self.k_x),
            *(half, in_x, model),
            n_bands=n,
            inward=False,
            own=self.own(k=k_x),
        )

    def forward(self, x: ImageBatch, y: ImageBatch, n, spread=False):
        """I2 from I1: x (n T, Ny, Nx), or (n / n_bands, Ny, Nx) if `spread`, to y (n, My, Mx)."""
        self.analyse(x, n, spread)
        self.show(y, n)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n T, Ny, Nx)."""
        self.take(y, n)
        self.synthesise(x, n)

    def show(self, y: ImageBatch, n):
        """I2 of `n` images, y (n, My, Mx), from `model_frequencies`."""
        if self.terms:
            self.terms.add(n)
        self.observe(y, n)

    def take(self, y: ImageBatch, n):
        """The adjoint of `show`, and conj(D) o of that: y (n, My, Mx) to `model_frequencies`."""
        self.way_back()
        self.collect(y, n)
        if self.terms:
            self.terms.spread(n)

    def observe(self, y: ImageBatch, n):
        """I2 of `n` images, y (n, My, Mx), from Z in scratch "frequencies"."""
        raise NotImplementedError

    def collect(self, y: ImageBatch, n):
        """The adjoint of `observe`, and conj(D) o of that unless there are terms, of which each has
        its own: y (n, My, Mx) into the same scratch."""
        raise NotImplementedError

    def to_frequencies(self, mix: Contraction, k, left: Matrix, right: Matrix, own_k=None):
        """The product Z = D o (left right), left (ky, k), right (k, kx); `mix` may conjugate D.
        Where there are terms, it is that without D. own_k (plans,): k of each plan, if not all's"""
        z, d, n = self.matrix("frequencies"), self.tables(self.transfer), self.n_bands
        own = self.own(m=self.k_ys, n=self.k_xs, k=own_k)
        if self.terms:
            d, mix = None, self.plain
        return mix.bind(self.k_y, self.k_x, k, left, right, z, d, n, own=own)

    def analyse(self, x: ImageBatch, n, spread=False):
        """Z = D o (Ty I1 Tx) for `n` images, into `model_frequencies`.

        spread: the images are n / n_bands, each of which is seen in every band
        """
        if spread:
            self.in_columns_once(n // self.n_bands, a=x)
            self.in_rows_shared(n * self.n_terms)
        else:
            self.in_columns(n * self.n_terms, a=x)
            self.in_rows(n * self.n_terms)

    def synthesise(self, x: ImageBatch, n):
        """I1 = Ty^T Z Tx^T of `n` images, Z in `model_frequencies`: the end of every adjoint."""
        self.back_rows(n * self.n_terms)
        self.back_columns(n * self.n_terms, c=x)


class Terms:
    """The sums over an executor's terms, at its frequencies, and the way back: kernels/terms.cl.

        Z = sum_t Z_t                        before the observed pixels, T images to one
        Z_t = conj(D_t) o Z                  the adjoint, with the transfer functions on the way

    executor: Executor of more than one term; its scratch "terms" holds Z_t, "frequencies" Z
    """

    def __init__(self, executor):
        e = self._executor = executor
        self._add, self._spread = (
            e.device.launcher(
                "terms.cl",
                name,
                dtype=e.dtype,
                local_size=e.tuning.local_size(3),
                ROWS=e.tuning.row_loops,
            )
            for name in ("add", "spread")
        )

    def bind(self, scratch):
        """Take the executor's intermediates, as they are by now."""
        e = self._executor
        buffer, stride, _ = e.tables(e.transfer)
        shared = {
            "n_terms": e.n_terms,
            "h_y": e.h_y,
            "n_pad": e.k_pad,
            "terms": scratch["terms"],
            "z": scratch["frequencies"],
        }
        self._add.bind(**shared)
        self._spread.bind(**shared, n_bands=e.n_bands, D=buffer, stride_d=stride)

    def add(self, n):
        """Queue the sums of `n` images."""
        self._run(self._add, n)

    def spread(self, n):
        """Queue the parts of `n` images."""
        self._run(self._spread, n)

    def _run(self, launch, n):
        e = self._executor
        launch((1 if e.tuning.row_loops else e.k_pad // 2, e.h_y, n))
