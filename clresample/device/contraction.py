"""Batched matrix products on the device: the contraction that every path is made of."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

# Columns of device matrices are padded with zeros to a multiple of this, the widest vector used.
COLUMN_PAD = 16
# Fewest terms summed at a stretch; the root of k balances the rounding of the stretches and of
# their sum. At 16 the float32 operator is twice as accurate as without, for 6 % of its time.
SUM_BLOCK = 16


def padded(n: int) -> int:
    """`n` columns rounded up to whole vectors."""
    return -(-n // COLUMN_PAD) * COLUMN_PAD


class Matrix(NamedTuple):
    """A batch of matrices in device memory; item b starts at offset + (b // div) * stride.

    buffer: OpenCL buffer; offset, ld, stride [elements]: start, distance of rows, of items
    step [elements]: distance of columns (only of a strided left factor, and of a ragged result)
    """

    buffer: object
    ld: int
    stride: int = 0
    div: int = 1
    step: int = 1
    offset: int = 0


class Contraction:
    """C[b] = A[b] . B[b], with an optional point-wise stage on the result; see kernels/contract.cl.

    epilogue: None, "MIX" (difference spectra) or "TWIST" (rotation of cos and sin rows)
    adjoint: conjugate the epilogue
    ragged: C is a caller's array, of any strides; otherwise its rows are padded with zeros
    strided: A's columns may be any distance apart; otherwise they are adjacent
    """

    def __init__(self, device, dtype, *, epilogue=None, adjoint=False, ragged=False, strided=False):
        self.device = device
        self.tile = _tile(device, np.dtype(dtype))
        defines = {epilogue: True} if epilogue else {}
        self.kernel = device.kernel(
            "contract.cl",
            "contract",
            dtype=dtype,
            SIGN=-1 if adjoint else 1,
            RAGGED=ragged,
            STRIDED=strided,
            **self.tile,
            **defines,
        )
        i, size = np.int32, np.uint64
        self.kernel.set_scalar_arg_dtypes(
            [i, i, i, i, i, None, size, i, i, i, i, None, i, i, None, size, i, i, i, None, i, i, i]
        )

    def __call__(self, m, n, k, batch, a: Matrix, b: Matrix, c: Matrix, e=None, n_bands=1):
        """Queue the product of `batch` (m, k) matrices A with (k, n) matrices B into C.

        e (buffer, stride, band stride): tables of the epilogue, shared by `n_bands` items
        """
        if (
            e is None
            and b.stride == 0
            and a.step == 1
            and a.stride == m * a.ld
            and a.div == 1
            and c.step == 1
            and c.stride == m * c.ld
        ):
            m, batch = m * batch, 1  # one right factor for all: their rows are one tall matrix
        n_pad = padded(n)
        buffer_e, stride_e, band_e = e or (None, 0, 0)
        self.kernel.set_args(
            m,
            n,
            n_pad,
            k,
            max(SUM_BLOCK, math.isqrt(k)),
            a.buffer,
            a.offset,
            a.ld,
            a.step,
            a.stride,
            a.div,
            b.buffer,
            b.stride,
            b.div,
            c.buffer,
            c.offset,
            c.ld,
            c.step,
            c.stride,
            buffer_e,
            stride_e,
            band_e,
            n_bands,
        )
        tile = self.tile
        x, y = -(-n_pad // (tile["NV"] * tile["VW"])), -(-m // tile["MR"])
        x, y = -(-x // tile["WGX"]) * tile["WGX"], -(-y // tile["WGY"]) * tile["WGY"]
        self.device.launch(self.kernel, (x, y, batch), (tile["WGX"], tile["WGY"], 1))


def _tile(device, dtype) -> dict:
    """Register tile of a work-item, measured on CPUs; for GPUs four floats (one 16-byte load) and a
    square of 64 work-items.

    Eight rows of two vectors use the 32 registers of AVX-512 and load little for each product;
    elsewhere, and in PoCL's code for AMD hosts of any kind, 16 registers hold six rows of one.
    """
    if device.kind != "CPU":
        return {"VW": 4 if dtype == np.float32 else 2, "NV": 1, "MR": 8, "WGX": 8, "WGY": 8}
    wide = device.cl.native_vector_width_float >= 16 and "AMD" not in device.name
    rows = {"NV": 2, "MR": 8} if wide else {"NV": 1, "MR": 6}
    return {"VW": 16 if dtype == np.float32 else 8, **rows, "WGX": 1, "WGY": 1}
