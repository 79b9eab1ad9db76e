"""Tables of all executors: the model's axes, the observed rows, the transfer functions."""

from __future__ import annotations

import numpy as np

from ...device.contraction import MatrixBatch, row_stride
from .device_memory import DeviceMemory


class ExecutorTables(DeviceMemory):
    """Tables of the model's axes and of the transfer functions, and the observed rows' Sy.

    plans: one for all items of a batch, or one for each item; smaller ones are padded with zeros
    axes: the model axes taken as rows and columns of I1
    n_rows: rows of Sy, set by a subclass before it calls this __init__
    k_ys, k_xs (plans,): ky and kx of each plan, of which k_y and k_x are the largest
    """

    n_rows: int

    def __init__(self, device, dtype, plans):
        super().__init__(device, dtype, plans)
        first = plans[0]
        self.n_terms, self.axes = first.n_terms, first.axes
        self.n_y, self.n_x = (first.mapping.shape_in[axis] for axis in self.axes)
        self.h_y, self.h_x = (max(len(p.nu[i]) for p in plans) for i in (0, 1))
        self.k_y, self.k_x = 2 * self.h_y, 2 * self.h_x
        self.k_pad = row_stride(self.k_x)
        self.k_ys, self.k_xs = np.array([[self.k_y, self.k_x]] * len(plans)).T
        if len(plans) > 1:
            self.k_ys, self.k_xs = 2 * np.array([[len(nu) for nu in p.nu] for p in plans]).T
            self.which = device.put(np.arange(len(plans)), np.int32)
        self.in_y = self._table([p.in_y for p in plans], self.k_y, self.n_y)
        self.in_x_t = self._table([p.in_x.T for p in plans], self.n_x, self.k_pad)
        self.out_y = self._table([p.out_y for p in plans], self.n_rows, self.k_y)
        shape = len(plans), self.n_bands * self.n_terms, self.h_y, 4, self.k_pad // 2
        self.transfer = device.empty(shape, dtype)

    def mirrored(self, name) -> bool:
        """Returns True if a table's halves, rows or columns, mirror each other in all plans."""
        return all(p.mirrored[name] for p in self.plans)

    @property
    def in_y_t(self) -> MatrixBatch:
        """Ty^T of the adjoint."""
        return self.cached("in_y_t", lambda: self._transposed("in_y", self.n_y, self.k_y))

    @property
    def in_x(self) -> MatrixBatch:
        """Tx^T of the adjoint."""
        shape, plans = (self.k_x, row_stride(self.n_x)), self.plans
        return self.cached("in_x", lambda: self._table([p.in_x for p in plans], *shape))

    def _transposed(self, name, *shape):
        """Tables of all plans on the device, transposed."""
        return self._table([getattr(plan, name).T for plan in self.plans], *shape)

    def set_transfer(self, transfer):
        """Uploads the transfer functions: a pair D(+,+), D(+,-) (C, Hy, Hx) for each plan.

        If one plan serves a batch, there is a pair for each item; call it before `clone` and
        `reserve`.
        """
        if len(transfer) != len(self.transfer):
            self.transfer = self.device.empty((len(transfer), *self.transfer.shape[1:]), self.dtype)
        host = np.zeros(self.transfer.shape, self.dtype)
        for item, (d_plus, d_minus) in zip(host, transfer, strict=True):
            planes = (d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)
            for i, plane in enumerate(planes):
                item[:, : plane.shape[1], i, : plane.shape[2]] = plane
        self.device.upload(host, self.transfer)
