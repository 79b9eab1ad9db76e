"""Slabs of the paper's scheme: the part worked on at once."""

from __future__ import annotations

import numpy as np

# One shifted value costs about as much as so many terms of the contraction: 8 operations, a store.
SHIFT_COST = 16


class Slab:
    """Units of the inner index worked off together; the contraction cuts them into equal chunks.

    first, n_units: the first unit, their number; n_rows: their terms, padded to n_chunks * chunk
    """

    def __init__(self, first, end, unit_rows, chunk_terms):
        self.first, self.n_units = int(first), int(end - first)
        n_rows = self.n_units * unit_rows
        self.n_chunks = -(-n_rows // chunk_terms)
        self.chunk = -(-n_rows // self.n_chunks)
        self.n_rows = self.n_chunks * self.chunk


def cut_slabs(n_units, unit_rows, n_slabs, chunk_terms):
    """`n_units` units of `unit_rows` terms in `n_slabs` slabs, which differ by one unit at most."""
    n_slabs = min(n_slabs, n_units)
    ends = np.linspace(0, n_units, n_slabs + 1).astype(int)
    return [Slab(*ends[i : i + 2], unit_rows, chunk_terms) for i in range(n_slabs)]
