"""An executor's tables and intermediates on the device."""

from __future__ import annotations

import copy
import math
from typing import Self

import numpy as np

from ...device.contraction import ItemSizes, MatrixBatch
from ...device.rounding import round_up
from ...device.tuning import Tuning


class DeviceMemory:
    """An executor's memory on the device: tables, and intermediates of the reserved images.

    device, dtype, tuning, plans, n_bands: of the executor
    n_reserved: number of images with memory; scratch: the intermediates, by their names
    which (items,): int32, on the device: the plan of each item; None if all items have one plan
    Subclasses implement scratch_shapes, bind and bind_adjoint
    """

    def __init__(self, device, dtype, plans):
        self.device, self.dtype, self.plans = device, dtype, plans
        self.tuning, self.n_bands = Tuning.of(device, dtype), plans[0].n_bands
        self.n_reserved, self.scratch = 0, {}
        self.which = None
        self._made = {}  # tables of the adjoint alone, made at its first use
        self._bound_back = False

    def scratch_shapes(self):
        """Intermediate matrices of one image: {name: (rows, elements of a row)}."""
        raise NotImplementedError

    def bind(self):
        """Binds the products, at least the forward ones, to the present scratch buffers."""
        raise NotImplementedError

    def bind_adjoint(self):
        """Binds the products of the adjoint, if a caller uses it."""

    def ensure_adjoint(self):
        """Binds the products of the adjoint if they are not bound yet."""
        if not self._bound_back:
            self.bind_adjoint()
            self._bound_back = True

    def select_plans(self, which):
        """Selects the plans `which` (items,) of the next items; `reserve` must precede it."""
        self.device.upload(np.ascontiguousarray(which, np.int32), self.which[: len(which)])

    def cached(self, name, make):
        """Result of `make()`, made once for this executor and those `clone` returns."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    def clone(self) -> Self:
        """An executor of the same tables on the device, with intermediates of its own.

        For callers that use the intermediates between two products of the chain. Both executors
        have the same pixel shift: setting it in one sets it in the other.
        """
        other = copy.copy(self)
        other.n_reserved, other.scratch, other._bound_back = 0, {}, False
        return other

    def reserve(self, n_images):
        """Makes room for the intermediates of `n_images` images at a time."""
        if self.n_reserved != n_images:
            # 0 until all products are bound, so that an interruption leaves a consistent state
            self.n_reserved, self._bound_back = 0, False
            # items with sizes of their own do not fill their matrices; sums may read the elements
            # beyond with weight 0, so these must be finite
            make = self.device.empty if self.which is None else self.device.zeros
            self.scratch = {
                name: make((n_images, rows, ld), self.dtype)
                for name, (rows, ld) in self.scratch_shapes().items()
            }
            self.bind()
            self.n_reserved = n_images

    def matrix(self, name, rows=None) -> MatrixBatch:
        """Intermediate matrices, with all their rows or the first ones of each."""
        array = self.scratch[name]
        return MatrixBatch(
            array.base_data, array.shape[2], (rows or array.shape[1]) * array.shape[2]
        )

    def tables(self, array):
        """Argument `e` of `Contraction.bind`: buffer, stride and band stride of its tables.

        array (plans or items, bands, ...): the tables that the products are multiplied by
        """
        stride = math.prod(array.shape[1:]) if len(array) > 1 else 0
        return array.base_data, stride, math.prod(array.shape[2:])

    def whole_groups(self, n):
        """`n` pixels of a line rounded up to whole groups of work-items."""
        return round_up(n, self.tuning.line_group)

    def item_sizes(self, **sizes) -> ItemSizes | None:
        """The ItemSizes of products with these sizes of each plan; None if all items share them."""
        return None if self.which is None else ItemSizes(self.which, **sizes)

    def _table(self, tables, *shape) -> MatrixBatch:
        """Host tables, one per plan, zero-padded to a common shape, on the device."""
        host = np.zeros((len(tables), *shape), self.dtype)
        for item, table in zip(host, tables, strict=True):
            item[tuple(slice(n) for n in table.shape)] = table
        stride = math.prod(shape) if len(tables) > 1 else 0
        table = self.device.put(host).base_data
        return MatrixBatch(
            table, shape[-1], stride, items_per_matrix=self.n_bands, own=len(tables) > 1
        )
