"""Stores the factors of all sources' blocks on the device and uploads only new ones."""

from __future__ import annotations

import numpy as np

from ....device.rounding import round_up
from ..boxes import ALIGN

# Ratio of a new array's size to that of the factors, when it must grow; and the smallest used
# fraction, below which a smaller array is made.
ROOM, MIN_USED = 1.5, 0.25


class FactorStore:
    """Stores the Cholesky factors of blocks in one array on a device, of a floating type.

    values: the array; those of a block begin at `first(block)`
    """

    def __init__(self, device, dtype):
        self._device, self._dtype = device, dtype
        self.values = device.zeros(ALIGN, dtype)
        self._first, self._end = {}, 0

    def first(self, block):
        """The first element of a CurvatureBlock's factor, a multiple of ALIGN."""
        return self._first[block]

    def retain(self, blocks):
        """Keeps the factors of these CurvatureBlocks and drops all others."""
        need = sum(_room(block) for block in blocks)
        new = [block for block in blocks if block not in self._first]
        full = self._end + sum(_room(block) for block in new) > self.values.size
        if full or need < MIN_USED * self.values.size:
            new, self._end = list(blocks), 0
            self.values = None  # before the next one is made
            self.values = self._device.zeros(max(int(ROOM * need), ALIGN), self._dtype)
            self._first = {}
        flat = np.zeros(sum(_room(block) for block in new), self._dtype)
        self._first = {block: self._first[block] for block in blocks if block in self._first}
        start = self._end
        for block in new:
            at = self._end - start
            flat[at : at + block.cholesky.size] = block.cholesky
            self._first[block] = self._end
            self._end += _room(block)
        if new:
            self._device.upload(flat, self.values[start : self._end])


def _room(block):
    """Number of elements of a CurvatureBlock's factor."""
    return round_up(block.cholesky.size, ALIGN)
