"""How much of the paper's scheme is worked on at once."""

from __future__ import annotations

# Terms that a work-item of the contraction sums: 16 columns of so many stay in a core's cache.
CHUNK = 1024
# A slab of the shifted model [bytes]: what a CPU's core has in its cache; a GPU wants all at once.
SLAB_BYTES = {"CPU": 2 << 20}
SLAB_BYTES_OTHER = 256 << 20
# One shifted value costs about as much as so many terms of the contraction: 8 operations, a store.
SHIFT_COST = 16


class Slab:
    """Units of the inner index worked off together; the contraction cuts them into equal chunks."""

    def __init__(self, first, end, unit_rows):
        self.first, self.n_units = int(first), int(end - first)
        n_rows = self.n_units * unit_rows
        self.n_chunks = -(-n_rows // CHUNK)
        self.chunk = -(-n_rows // self.n_chunks)
        self.n_rows = self.n_chunks * self.chunk
