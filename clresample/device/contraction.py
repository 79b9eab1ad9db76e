"""Batched matrix products on the device: the contraction that every executor is made of."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .rounding import round_up
from .tuning import MAX_GROUPS, Tuning

# Kernels: for CPUs, whose tiles are in registers, and for GPUs, whose groups use local memory.
FILE, GROUP_FILE = "contract.cl", "contract_group.cl"
# Columns of device matrices are padded with zeros to a multiple of this, the widest OpenCL vector.
COLUMN_PAD = 16
# If the row length is a multiple of this many elements, all rows begin in few sets of a core's
# first cache, where the columns of B that a tile reads then do not fit: such rows get one more
# vector. Products with 128 or 256 columns take 4 to 11 % less time on AVX2.
CROWDED = 128
# Largest number of terms in one partial sum, before the partial sums are added. With 16, products
# take up to 10 % longer on CPUs; with 256, 5 % less, but rounding errors of frames of 400 pixels
# are half as large again.
SUM_BLOCK = 64
# Tiles that a work-item of the CPU kernel computes, one below the other, while their columns of B
# stay in its core's first cache. With 1, products take 3 to 8 % longer on AVX2. With 16 they take
# as long as with 8, and a single image has fewer work-items for many cores.
ROW_TILES = 8
# Terms added in one iteration of the CPU kernel's loop, KU of contract.h. Partial sums have a
# multiple of this number of terms.
TERMS = 4
# Stages after a product, as the kernels for CPUs number them.
EPILOGUES = (None, "MIX", "TWIST")
# Largest number of terms that the GPU kernel adds in a single sum: partial sums would take half of
# a GPU's registers.
ONE_SUM = 256


def round_up_columns(n):
    """`n` columns rounded up to whole vectors; elementwise for an array."""
    return round_up(n, COLUMN_PAD)


def row_stride(n):
    """Row stride [elements] of device matrices with `n` columns; elementwise for an array.

    Products write the columns up to `round_up_columns(n)`, with zeros from n on. Columns beyond
    these are not written.
    """
    n = round_up_columns(n)
    return n + COLUMN_PAD * (n % CROWDED == 0)


def terms_per_block(k: int) -> int:
    """Number of terms in one partial sum of a sum of k terms.

    At most SUM_BLOCK, or sqrt(k) if that is more, so that the partial sums and their total have
    equal rounding errors. The number of partial sums is even, as many from each end of the sum. The
    result is a multiple of TERMS: only the last partial sum of each end has single terms left.
    """
    n_stretches = 2 * max(1, -(-k // (2 * SUM_BLOCK)))
    return round_up(max(math.isqrt(k), -(-k // n_stretches)), TERMS)


class MatrixBatch(NamedTuple):
    """A batch of matrices in device memory; item b starts at offset + (b // div) * stride.

    buffer: OpenCL buffer, or None if it is passed to each call of a BoundContraction
    offset, ld, stride [elements]: start, distance of rows, of items
    step [elements]: distance of columns (only of a strided left factor, and of a ragged result)
    own: if the product has ItemSizes, item b starts at its `table_index` instead
    """

    buffer: object
    ld: int
    stride: int = 0
    items_per_matrix: int = 1
    step: int = 1
    offset: int = 0
    own: bool = False


class ItemSizes(NamedTuple):
    """Sizes and tables of each item of a batch.

    table_index (batch / n_bands,): int32, on the device: the table of each n_bands items in turn
    m, n, k (tables,): rows, columns and terms of each; None if all equal those of the product
    """

    table_index: object
    m: np.ndarray | None = None
    n: np.ndarray | None = None
    k: np.ndarray | None = None

    def sizes(self, m, n, k):
        """Sizes (tables, 3), those of the product if None. Raises ValueError for larger ones."""
        found = [
            most if own is None else own for own, most in zip(self[1:], (m, n, k), strict=True)
        ]
        table = np.stack(np.broadcast_arrays(*found), axis=1)
        if (table > (m, n, k)).any():
            raise ValueError(
                f"own sizes reach {table.max(axis=0)}, must be at most the product's {(m, n, k)}"
            )
        return table


class ImageBatch(NamedTuple):
    """Images of a caller's device array, image b at offset + b * stride in `buffer`.

    offset, stride, ld [elements]: start, distance of images, of their rows
    """

    buffer: object
    offset: int
    stride: int
    ld: int

    @classmethod
    def of(cls, array, first=0, every=1) -> ImageBatch:
        """Images first, first + every, ... of a pyopencl array (..., Ny, Nx), in its order."""
        n_y, n_x = array.shape[-2:]
        offset = array.offset // array.dtype.itemsize + first * n_y * n_x
        return cls(array.base_data, offset, every * n_y * n_x, n_x)

    @classmethod
    def shaped(cls, n_y, n_x, every=1) -> ImageBatch:
        """Every `every`-th of many images (n_y, n_x) of an array that is passed later."""
        return cls(None, 0, every * n_y * n_x, n_x)

    def matrix(self, axes=(0, 1)) -> MatrixBatch:
        """The images as matrices, transposed where `axes` is (1, 0)."""
        ld, step = (self.ld, 1) if axes == (0, 1) else (1, self.ld)
        return MatrixBatch(self.buffer, ld, self.stride, step=step, offset=self.offset)


class Contraction:
    """C[b] = A[b] . B[b], with an optional point-wise stage on the result; see kernels/contract.cl.

    The kernel and its tile are Tuning's, by device, type and shape.

    epilogue: None, "MIX" (transfer functions) or "TWIST" (rotation of cos and sin rows)
    adjoint: conjugate the epilogue
    ragged: C is a caller's array, of any strides; otherwise its rows are padded with zeros
    strided: A's columns may be any distance apart; otherwise they are adjacent
    tuning: Tuning of device and dtype, which otherwise takes 60 us to compute
    """

    def __init__(
        self,
        device,
        dtype,
        *,
        epilogue=None,
        adjoint=False,
        ragged=False,
        strided=False,
        tuning=None,
    ):
        self.device, self.dtype = device, dtype
        self.tuning = tuning or Tuning.of(device, dtype)
        self.ragged, self.options = ragged, {"STRIDED": strided}
        self.epilogue, self.sign = epilogue, -1 if adjoint else 1

    def build(self, n_rows=None, n_terms=0, n=0):
        """(file, macros) for numbers of rows, terms and columns; by default the largest."""
        two_sums = "KB" in self.tuning.tile and n_terms > ONE_SUM
        tile = self.tuning.tile_for(n_rows or None, two_sums=two_sums)
        if "KB" not in tile:
            own = {"RT": ROW_TILES, "READ_AHEAD": self.tuning.prefetch_columns}
            return FILE, self.options | own | self.tuning.tile_for_columns(n, round_up_columns(n))
        stage = {"SIGN": self.sign} | ({self.epilogue: True} if self.epilogue else {})
        stage["RAGGED"] = self.ragged
        return GROUP_FILE, self.options | stage | tile | {"TWO_SUMS": two_sums}

    def bind(
        self,
        m,
        n,
        k,
        a: MatrixBatch,
        b: MatrixBatch,
        c: MatrixBatch,
        e=None,
        n_bands=1,
        *,
        inward=True,
        own=None,
    ) -> BoundContraction:
        """The products of (m, k) matrices A with (k, n) matrices B into C.

        inward: the largest terms lie in the middle, as for sums over pixels; if False they come
            first, as for sums over frequencies. Small terms are added first, to round less
        e (buffer, stride, band stride): tables of the epilogue, shared by `n_bands` items
        own: ItemSizes, of whose sizes m, n and k are the largest; C is not written beyond an item's
        """
        buffer_e, stride_e, band_e = e or (None, 0, 0)
        # one right factor for all items: their rows are stacked into one tall matrix
        whole_a = a.step == 1 and a.stride == m * a.ld and a.items_per_matrix == 1
        tall = e is None and b.stride == 0 and whole_a and c.step == 1 and c.stride == m * c.ld
        file, tile = self.build(None if tall else m, k, n)
        if "KB" in tile:
            tile = tile | {"OWN": own is not None}
        which = own and own.table_index
        sizes = own and self.device.put(own.sizes(m, n, k), np.int32)
        launch = self.device.launcher(
            file,
            file.removesuffix(".cl"),
            dtype=self.dtype,
            local_size=(tile["WGX"], tile["WGY"], 1),
            **tile,
        ).bind(
            m=m,
            n=n,
            n_pad=row_stride(n),
            k=k,
            **self._order(k, inward),
            A=a.buffer,
            offset_a=a.offset,
            ld_a=a.ld,
            step_a=a.step,
            stride_a=a.stride,
            div_a=0 if own and a.own else a.items_per_matrix,
            B=b.buffer,
            stride_b=b.stride,
            div_b=0 if own and b.own else b.items_per_matrix,
            C=c.buffer,
            offset_c=c.offset,
            ld_c=c.ld,
            step_c=c.step,
            stride_c=c.stride,
            E=buffer_e,
            stride_e=stride_e,
            band_e=band_e,
            n_bands=n_bands,
            which=which,
            own=sizes,
            **self._stage(file),
        )
        starts = (a.offset, a.stride, c.offset, c.stride)
        return BoundContraction(launch, tile, m, self._extent(tile, n), starts if tall else None)

    def _extent(self, tile, n):
        """Rows and columns of C computed by one work-item, and columns computed by all."""
        return tile["MR"] * tile.get("RT", 1), tile["NV"] * tile["VW"], round_up_columns(n)

    def _stage(self, file):
        """Arguments of the kernels for CPUs, which are macros of the one for GPUs."""
        if file == GROUP_FILE:
            return {}
        stage = {"epilogue": EPILOGUES.index(self.epilogue), "sign": self.sign}
        return stage | ({"ragged": self.ragged} if file == FILE else {})

    def _order(self, k, inward):
        """The order in which the kernel sums k terms, as its arguments."""
        return {"block": terms_per_block(k), "inward": inward}


class BoundContraction:
    """A contraction with all its matrices bound; `Contraction.bind` makes it.

    tall: if items are stacked into one matrix of m rows each, the offsets and strides of A and
        C [elements]; else None
    """

    def __init__(self, launch, tile, m, extent, tall):
        self.launch, self.m, self.tall = launch, m, tall
        (self.rows, columns, width), self.group_rows = extent, tile["WGY"]
        self.n_x = round_up(-(-width // columns), tile["WGX"])

    def __call__(self, batch, *, a=None, c=None):
        """Queues `batch` products.

        a, c (ImageBatch): left factor and result of this call, with the strides that were bound
        """
        given, m = {}, self.m
        if a is not None:
            given["A"], given["offset_a"] = a.buffer, a.offset
        if c is not None:
            given["C"], given["offset_c"] = c.buffer, c.offset
        if not self.tall:
            self._launch(m, batch, given)
            return
        a0, stride_a, c0, stride_c = self.tall
        a0, c0 = given.get("offset_a", a0), given.get("offset_c", c0)
        most = max(1, MAX_GROUPS * self.group_rows * self.rows // m)  # items, one launch each
        for first in range(0, batch, most):
            m_tall = m * min(most, batch - first)
            if first:
                given |= {"offset_a": a0 + first * stride_a, "offset_c": c0 + first * stride_c}
            self._launch(m_tall, 1, given | {"m": m_tall})

    def _launch(self, m, batch, given):
        n_y = round_up(-(-m // self.rows), self.group_rows)
        self.launch((self.n_x, n_y, batch), **given)


def box_product(device, dtype, *, strided, ragged, tuning=None):
    """Launcher of kernels/boxed.cl; see `BoxedProduct` of the solver for its layouts."""
    tuning = tuning or Tuning.of(device, dtype)
    tile, on_cpu = tuning.tile_for_boxes, tuning.row_loops
    return device.launcher(
        "boxed.cl",
        "multiply_boxes",
        dtype=dtype,
        local_size=(tile["WGX"], tile["WGY"], 1),
        STRIDED=strided,
        RAGGED=ragged and not on_cpu,  # there an argument
        ON_CPU=on_cpu,
        **tile,
    )
