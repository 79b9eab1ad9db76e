"""One product of matrices for each source, of the size of its box: kernel boxed.cl."""

from __future__ import annotations

import math

import numpy as np

from ....device.contraction import box_product, round_up_columns, terms_per_block

# The columns of the kernel's table, each int64.
COLUMNS = ["m", "n", "k", "begin_a", "ld_a", "next_a", "begin_b", "ld_b", "skip"]
COLUMNS += ["begin_c", "ld_c", "next_c"]


class BoxedProduct:
    """C[s] = A[s] . B[s] for every source s of a batch, all at once.

    buffers: the batch
    strided: A's columns lie next_a apart; ragged: C is stored element by element, n of them in a
        row, else by vectors up to a multiple of 16
    inward: sums are over pixels, and not over frequencies; see Contraction.bind
    sizes: a value or an array (S,) for each of COLUMNS; next_a and next_c are 1 by default, skip 0
    """

    def __init__(self, buffers, *, strided=False, ragged=False, inward=True, **sizes):
        b, sizes = buffers, {"next_a": 1, "next_c": 1, "skip": 0} | sizes
        items = [np.broadcast_to(sizes[name], b.n_sources) for name in COLUMNS]
        tile, m, width = b.tuning.tile_for_boxes, max(items[0]), max(items[1] + items[8])
        group = tile["WGX"], tile["WGY"]
        along = math.ceil(round_up_columns(int(width)) / (tile["VW"] * tile["NV"]))
        tiles = b.along_row(along), int(m) / tile["MR"]
        self._size = tuple(math.ceil(n / g) * g for n, g in zip(map(math.ceil, tiles), group))
        self._launch = box_product(
            b.device, b.dtype, strided=strided, ragged=ragged, tuning=b.tuning
        ).bind(
            items=b.device.put(np.stack(items, axis=1), np.int64),
            block=terms_per_block(int(max(items[2]))),
            inward=inward,
            ragged=ragged,
        )

    def __call__(self, a, b, c, active, *, add=False):
        """Queues the products of the sources `active` (n,): C from A and B, added if ragged."""
        self._launch((*self._size, active.size), A=a, B=b, C=c, active=active, add=add)
