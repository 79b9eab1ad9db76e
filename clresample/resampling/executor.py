"""What the executors of all geometries share: from a model to its frequencies and back.

    forward   Z = D o (Ty I Tx)            both axes to frequencies, then the difference spectra
              aligned    I2 = Sy Z Sx
              affine     g = Sy twist(Z Sx),  I2 = gather(g) along each line
              distorted  I2[p] = sum_x (Sy Z)[p, x] Sx[p, x]
    adjoint   the same factors transposed, in reverse order

All matrices are real: rows or columns 2i, 2i+1 are the cos and sin parts of frequency i.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..device.contraction import Contraction, Matrix, padded

# Work-items of a group along a line.  Left to choose, CPU runtimes pick another number for every
# image size and build the kernel anew for each, 0.1 to 0.3 s; and 32 is one GPU warp.
GROUP = 32


class Images(NamedTuple):
    """`count` images of a caller, item b at offset + b * stride in `buffer` [elements]."""

    buffer: object
    offset: int
    shape: tuple[int, int]

    @property
    def stride(self):
        return self.shape[0] * self.shape[1]

    def matrix(self, axes=(0, 1)) -> Matrix:
        """The images as matrices, transposed where `axes` is (1, 0)."""
        ld, step = (self.shape[1], 1) if axes == (0, 1) else (1, self.shape[1])
        return Matrix(self.buffer, ld, self.stride, step=step, offset=self.offset)


class Executor:
    """What the three paths share: the model's two axes and the difference spectra.

    plans: one for all items of a batch, or one for each item; smaller ones are padded with zeros
    """

    def __init__(self, device, dtype, plans):
        self.device, self.dtype, self.plans = device, dtype, plans
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
        self.spectra = device.empty((len(plans), self.n_bands, self.h_y, 4, self.k_pad // 2), dtype)
        self.plain = Contraction(device, dtype)
        self.first = Contraction(device, dtype, strided=self.axes != (0, 1))
        self.ragged = Contraction(device, dtype, ragged=True)
        self.mix = Contraction(device, dtype, epilogue="MIX")
        self.mix_adjoint = Contraction(device, dtype, epilogue="MIX", adjoint=True)
        self.scratch = {}

    # rows and row length of the intermediate matrices, per image: name -> (rows, ld)
    def scratch_shapes(self):
        n_half = max(self.n_y, self.n_rows)
        return {"half": (n_half, self.k_pad), "spectrum": (self.k_y, self.k_pad)}

    def reserve(self, n_images):
        """Make room for the intermediates of `n_images` images at a time."""
        if self.scratch.get("n_images", 0) != n_images:
            self.scratch = {"n_images": n_images} | {
                name: self.device.empty((n_images, rows, ld), self.dtype)
                for name, (rows, ld) in self.scratch_shapes().items()
            }

    def set_spectra(self, spectra):
        """Upload D(+,+), D(+,-): one pair (C, Hy, Hx) for each plan."""
        host = np.zeros(self.spectra.shape, self.dtype)
        for item, (d_plus, d_minus) in zip(host, spectra, strict=True):
            planes = (d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)
            for i, plane in enumerate(planes):
                item[:, : plane.shape[1], i, : plane.shape[2]] = plane
        self.device.upload(host, self.spectra)

    def analyse(self, images: Images, n, spread=False):
        """Z = D o (Ty I Tx) for `n` images, into scratch "spectrum".

        spread: the images are n / n_bands, each of which is seen in every band
        """
        half = self._scratch("half", self.n_y)
        in_x_t = self.in_x_t._replace(div=1) if spread else self.in_x_t
        self.first(
            self.n_y,
            self.k_x,
            self.n_x,
            n // self.n_bands if spread else n,
            images.matrix(self.axes),
            in_x_t,
            half,
        )
        if spread:
            half = half._replace(div=self.n_bands)
        self.to_spectrum(self.mix, self.n_y, self.in_y, half, n)

    def to_spectrum(self, mix: Contraction, k, left: Matrix, right: Matrix, n):
        """Z = D o (left right) over k terms, into scratch "spectrum"; `mix` may conjugate D."""
        mix(
            self.k_y,
            self.k_x,
            k,
            n,
            left,
            right,
            self._scratch("spectrum"),
            self._epilogue(self.spectra),
            self.n_bands,
        )

    def synthesise(self, images: Images, n):
        """I = Ty^T Z Tx^T of `n` images, from scratch "spectrum": the model end of the adjoint."""
        half, z = self._scratch("half", self.n_y), self._scratch("spectrum")
        self.plain(self.n_y, self.k_x, self.k_y, n, self.in_y_t, z, half)
        self.ragged(self.n_y, self.n_x, self.k_x, n, half, self.in_x, images.matrix(self.axes))

    def _table(self, tables, *shape) -> Matrix:
        """Host tables, one per plan, zero-padded to a common shape, on the device."""
        host = np.zeros((len(tables), *shape), self.dtype)
        for item, table in zip(host, tables, strict=True):
            item[tuple(slice(n) for n in table.shape)] = table
        stride = math.prod(shape) if len(tables) > 1 else 0
        return Matrix(self.device.put(host).base_data, shape[-1], stride, div=self.n_bands)

    def _scratch(self, name, rows=None) -> Matrix:
        array = self.scratch[name]
        return Matrix(array.base_data, array.shape[2], (rows or array.shape[1]) * array.shape[2])

    def _epilogue(self, array):
        stride = math.prod(array.shape[1:]) if len(self.plans) > 1 else 0
        return array.base_data, stride, math.prod(array.shape[2:])


def whole_groups(n):
    return -(-n // GROUP) * GROUP
