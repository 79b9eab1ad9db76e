"""The chain of aligned geometries in float64 between float32 images, at float32's cost.

A product in float64 takes a CPU twice as long. Images in parts even and odd about their middles
need half of the products, since a cos meets even parts alone and a sin odd ones. So a float32
operator may round its input and its output and nothing between; in float32 throughout, tables,
intermediates and sums are rounded too: 1e-7 of an image instead of 3e-8.

    forward   I2 = unfold(Sy (D o (Ty fold(I1) Tx)) Sx)
    adjoint   the same factors transposed, in reverse order

D holds the way from the model's middle to the observation's, and all waves are about the middles.
"""

from __future__ import annotations

import numpy as np

from ...device.contraction import ImageBatch
from ...device.tuning import Tuning
from ..plan import Plan
from ..tables import waves

# [bytes] of float64 intermediates of one image, which one work-item takes through the whole chain:
# half of a core's second cache of 2 MiB. Larger images are better shared among cores, product by product.
MOST_BYTES = 1 << 20


class FoldedExecutor:
    """Forward and adjoint of one aligned Plan, as Executor has them; inside it is float64.

    Images on either side are float32. `serves` says for which operators it is made.
    """

    def __init__(self, device, plan: Plan):
        self.plan, self.n_bands = plan, plan.n_bands
        self.tuning = Tuning.of(device, np.float64)
        self._device, self._vector = device, self.tuning.tile["VW"]
        self.h_pad = self.whole_vectors(len(plan.nu[1]))
        mapping, axes = plan.mapping, plan.axes
        shape = tuple(mapping.shape_in[axis] for axis in axes)
        tables = [table[:, n // 2 :].T for table, n in zip((plan.in_y, plan.in_x), shape)]
        self._model = model = Side(self, shape, tables, [np.ones(n) for n in shape], axes)
        off = [np.arange(n // 2, n) - (n - 1) / 2 for n in mapping.shape_out]
        rates = [mapping.matrix[axes[i], i] for i in (0, 1)]
        tables = [waves(nu, rate * x) for nu, rate, x in zip(plan.nu, rates, off)]
        lit = [mapping.covered.any(axis=1 - i) for i in (0, 1)]
        self._observed = observed = Side(self, mapping.shape_out, tables, lit, (0, 1))
        middle_in, middle_out = (
            (np.array(n) - 1) / 2 for n in (mapping.shape_in, mapping.shape_out)
        )
        self._middle = mapping.matrix @ middle_out + mapping.offset - middle_in
        self._transfer = device.empty((self.n_bands, len(plan.nu[0]), 4, self.h_pad), np.float64)
        # one for each core, so that it stays in its cache
        n_parts, n_lines, n_z = n_elements(plan, self.whole_vectors)
        self.scratch = device.empty((device.compute_units, n_parts + n_lines + n_z), np.float64)
        at = {"at_lines": n_parts, "at_z": n_parts + n_lines}
        self._forward = self._bound(model, observed, 1, at)
        self._adjoint = self._bound(observed, model, -1, at)

    @staticmethod
    def serves(device, dtype, plans) -> bool:
        """Whether it is as fast as float32 there, and rounds less: on CPUs, for small images."""
        cpu = device.kind == "CPU" and not device.simulated and device.has_fp64
        if not cpu or np.dtype(dtype) != np.float32 or len(plans) > 1:
            return False
        plan = plans[0]
        small = 8 * sum(n_elements(plan)) <= MOST_BYTES
        return plan.geometry == "aligned" and plan.n_terms == 1 and small

    @property
    def n_bytes(self) -> int:
        """Device memory of tables and intermediates [bytes]."""
        sides = self._model.n_bytes + self._observed.n_bytes
        return sides + self._transfer.nbytes + self.scratch.nbytes

    def whole_vectors(self, n):
        """`n` columns rounded up to whole vectors."""
        return -(-n // self._vector) * self._vector

    def set_shift(self, shift):
        """Upload D with every observed pixel moved by `shift` (2,) [model px]."""
        host = np.zeros(self._transfer.shape)
        d_plus, d_minus = self.plan.shifted(shift + self._middle)
        for i, plane in enumerate((d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)):
            host[:, :, i, : plane.shape[2]] = plane
        self._device.upload(host, self._transfer)

    def forward(self, x: ImageBatch, y: ImageBatch, n, spread=False):
        """I2 from I1: x (n, Ny, Nx), or (n / n_bands, Ny, Nx) if `spread`, to y (n, My, Mx)."""
        self._queue(self._forward, x, y, n, self.n_bands if spread else 1)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n, Ny, Nx)."""
        self._queue(self._adjoint, y, x, n, 1)

    def reserve(self, n_images):
        """Nothing: there are intermediates for each core, whatever the number of images."""

    def _queue(self, way, source: ImageBatch, target: ImageBatch, n, n_seen):
        """Queue one way to `n` images, `n_seen` of them from each that goes in."""
        launch, source_axes, target_axes = way
        given = {"n_sources": n // n_seen, "n_seen": n_seen}
        for name, images, axes in (
            ("source", source, source_axes),
            ("target", target, target_axes),
        ):
            at = images.matrix(axes)
            given |= {name: at.buffer, f"{name}_offset": at.offset, f"{name}_stride": at.stride}
            given |= {f"{name}_ld": at.ld, f"{name}_step": at.step}
        launch((min(n // n_seen, len(self.scratch)), 1, 1), **given)

    def _bound(self, source: Side, target: Side, sign, at):
        """The kernel of one way, and the axes of its images."""
        launch = self._device.launcher(
            "folded.cl",
            "folded",
            dtype=np.float64,
            local_size=(1, 1, 1),
            SIGN=sign,
            SPACED=(1, 0) in (source.axes, target.axes),
            **{name: self.tuning.tile[name] for name in ("VW", "NV", "MR")},
        ).bind(
            n_bands=self.n_bands,
            h_y=len(self.plan.nu[0]),
            h_x=len(self.plan.nu[1]),
            h_pad=self.h_pad,
            D=self._transfer,
            scratch=self.scratch,
            stride_scratch=self.scratch.shape[1],
            **at,
            **source.arguments(to_frequencies=True),
            **{f"to_{name}": value for name, value in target.arguments(False).items()},
        )
        return launch, source.axes, target.axes


class Side:
    """The images of one end of the operator, and waves about their middle.

    folded: the executor
    shape (2,) [px]: along the tables' axes, which are the images' `axes`
    tables (half_y, 2 Hy), (half_x, 2 Hx): waves at the pixels from the middle on, cos, sin in turn
    lit (n_y,), (n_x,): 0 of rows and columns that do not count, else 1
    """

    def __init__(self, folded: FoldedExecutor, shape, tables, lit, axes):
        self.axes, device = axes, folded._device
        half = [(n + 1) // 2 for n in shape]
        y, x = (np.stack([wave[:, 0::2], wave[:, 1::2]]) for wave in tables)  # (2, half, H)
        pad_x = folded.whole_vectors(half[1])
        self._shared = {"n_y": shape[0], "n_x": shape[1], "pad_x": pad_x}
        for name, *sizes in zip(("weight_y", "weight_x"), shape, half, lit):
            self._shared[name] = device.put(_weights(*sizes))
        x_t = x.swapaxes(1, 2)
        self._to = device.put(_turned(y)), device.put(_padded(x, folded.h_pad))
        self._from = device.put(y), device.put(_padded(x_t, pad_x))

    def arguments(self, to_frequencies):
        """What the kernel takes of this side."""
        wave_y, wave_x = self._to if to_frequencies else self._from
        return self._shared | {"wave_y": wave_y, "wave_x": wave_x}

    @property
    def n_bytes(self) -> int:
        """Device memory of the tables [bytes]."""
        arrays = *self._to, *self._from, *self._shared.values()
        return sum(getattr(array, "nbytes", 0) for array in arrays)


def n_elements(plan: Plan, whole_vectors=lambda n: n):
    """Elements of one image's intermediates: its parts, their lines, and frequencies twice."""
    mapping, (h_y, h_x) = plan.mapping, (len(nu) for nu in plan.nu)
    shapes = [mapping.shape_out, tuple(mapping.shape_in[axis] for axis in plan.axes)]
    half = [[(n + 1) // 2 for n in shape] for shape in shapes]
    h_pad = whole_vectors(h_x)
    parts = max(4 * y * whole_vectors(x) for y, x in half)
    return parts, max(4 * y * h_pad for y, _ in half), 8 * h_y * h_pad


def _weights(n, n_half, lit):
    """Weights (2, n_half) of the pixels after the middle of `n` and of their partners before it."""
    lit = np.asarray(lit, np.float64)
    after, before = lit[n // 2 :], lit[:n_half][::-1].copy()
    before[0] *= 1 - n % 2  # a middle pixel has no partner
    return np.stack([after, before])


def _turned(tables):
    """Tables (2, a, b) as (2, b, a)."""
    return np.ascontiguousarray(tables.swapaxes(1, 2))


def _padded(tables, n):
    """Tables (2, a, b) with their rows zero-padded to `n` columns."""
    return np.pad(tables, ((0, 0), (0, 0), (0, n - tables.shape[2])))
