"""Launches of shift.cl: shifted models from frequencies, observed pixels from partial sums."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from ...device.contraction import BoundContraction, MatrixBatch
from ...device.rounding import round_up
from ...device.tuning import Tuning


class SlabLaunches(NamedTuple):
    """Launches of forward and adjoint for one slab; all but the products take no arguments.

    shift: G from the frequencies; product(n_chunks): partial sums P G
    product_t(1): P^T times the observed pixels, into G; unshift: from G back to the frequencies
    """

    shift: functools.partial
    product: BoundContraction
    n_chunks: int
    product_t: BoundContraction
    unshift: functools.partial


class ShiftLaunches:
    """Shifted models G from frequencies Z, and back: the kernels shift_* and unshift_*.

    name: "line" or "plane", the kernels of aligned and of rotated grids
    h_x: frequencies of the axis along columns; lanes: columns a work-item takes
    """

    def __init__(self, device, dtype, name, h_x, lanes):
        self.h_x, self.lanes = h_x, lanes
        tuning = Tuning.of(device, dtype)
        self.launchers = [
            functools.partial(
                device.launcher,
                "shift.cl",
                f"{way}_{name}",
                dtype=dtype,
                local_size=local_size,
                LANES=lanes,
            )
            for way, local_size in (("shift", tuning.tile_group), ("unshift", tuning.item_group))
        ]

    def bind(self, slab, z: MatrixBatch, waves, g, n_cols, ld, n):
        """The launches for a slab's units of `n` images: Z to G, and its adjoint, G to Z.

        waves (w_y, w_x): buffers (h, 2, n_cols); g: device array of rows ld long, n * n_cols used
        """
        rows = self.h_x, slab.n_units * n
        sizes = (n_cols // self.lanes, *rows), rows
        return [
            functools.partial(
                launcher().bind(
                    h_x=self.h_x,
                    n_units=slab.n_units,
                    first=slab.first,
                    Z=z.buffer,
                    stride_z=z.stride,
                    ld_z=z.ld,
                    w_y=waves[0],
                    w_x=waves[1],
                    G=g,
                    n_cols=n_cols,
                    ld=ld,
                ),
                size,
            )
            for launcher, size in zip(self.launchers, sizes, strict=True)
        ]


class PixelLaunches:
    """Observed pixels from the partial sums of all chunks, and back: collect and spread.

    mapping: its observed pixels, and which of them the model covers; axis: the observed axis of
        steps i, the other one's are l
    n_cols: columns of an image in the sums, n_i rounded up; lanes: of the file's other kernels
    """

    def __init__(self, device, dtype, mapping, axis, n_cols, lanes):
        self.n_i, self.n_l = mapping.shape_out[axis], mapping.shape_out[1 - axis]
        steps = mapping.shape_out[1], 1
        self.steps = {"step_l": steps[1 - axis], "step_i": steps[axis]}
        self.n_cols = n_cols
        self.covered = device.put(mapping.covered.astype(np.uint8))
        group = Tuning.of(device, dtype).line_group
        self._group = group
        self.launchers = [
            functools.partial(
                device.launcher, "shift.cl", name, dtype=dtype, local_size=local_size, LANES=lanes
            )
            for name, local_size in (("sum_chunks", (group, 1, 1)), ("scatter_pixels", (group, 1)))
        ]

    def bind(self, part, n_chunks, ld, n):
        """The launches between partial sums and `n` images; each call gives where these lie.

        collect: pixels (n, My, Mx) = sums over the chunks of part (n_chunks, n_l, ld); 0 if not
            covered
        spread: the adjoint for one chunk, part (1, n_l, ld) = pixels where covered, else 0
        """
        given = {"ld": ld, "part": part, "covered": self.covered, "n_cols": self.n_cols}
        whole = round_up(ld, self._group)
        collect, spread = (launcher().bind(**given, **self.steps) for launcher in self.launchers)
        return (
            functools.partial(
                collect.bind(n_chunks=n_chunks, n_i=self.n_i), (self.n_i, self.n_l, n)
            ),
            functools.partial(spread.bind(n_items=n, n_i=self.n_i), (whole, self.n_l)),
        )
