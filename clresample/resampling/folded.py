"""The chain of aligned geometries in float64 between float32 images, at float32's cost.

On CPUs a float64 product takes twice as long as a float32 product. If images are split into parts
even and odd about their middles, half of the products suffice: cosines need the even parts only,
and sines the odd parts. So a float32 operator can compute in float64 at no cost, and rounds only
its input and output. The error is 3e-8 of an image, instead of 1e-7 in float32 throughout.

    forward   I2 = unfold(Sy (D o (Ty fold(I1) Tx)) Sx)
    adjoint   the same factors transposed, in reverse order

D contains the phase from the model's middle to the observation's; all waves are about the middles.
"""

from __future__ import annotations

import numpy as np

from ..device.contraction import ImageBatch
from ..device.rounding import round_up
from ..device.tuning import Tuning
from .plan import ResamplingPlan
from .wave_tables import wave_table

# [bytes] Largest float64 intermediates of one image, which one work-item computes from end to end:
# half of a core's second cache. Images of more than some 200 pixels a side are faster if cores
# share each product.
MAX_BYTES = 1 << 20


class FoldedExecutor:
    """Forward and adjoint of one aligned ResamplingPlan, with the interface of Executor.

    It computes in float64.

    Images on either side are float32. `is_preferred` tests if an operator should use it.

    scratch: its arrays on the device, by names; empty before the first use
    """

    def __init__(self, device, plan: ResamplingPlan):
        self.device, self.plan, self.tuning = device, plan, Tuning.of(device, np.float64)
        self.scratch: dict = {}
        self._transfer = np.zeros((plan.n_bands, len(plan.nu[0]), 4, self.h_pad))

    @staticmethod
    def is_preferred(device, dtype, plan) -> bool:
        """Returns True if it is as fast as float32 and rounds less: on CPUs, for small images."""
        if np.dtype(dtype) != np.float32 or not (device.has_fp64 and Tuning.of(device).use_folded):
            return False
        small = 8 * sum(n_elements(plan)) <= MAX_BYTES
        return plan.geometry == "aligned" and plan.n_terms == 1 and small

    @property
    def h_pad(self):
        """Columns of frequencies, in whole vectors."""
        return self.whole_vectors(len(self.plan.nu[1]))

    def whole_vectors(self, n):
        """`n` columns rounded up to whole vectors."""
        return round_up(n, self.tuning.tile["VW"])

    def set_transfer(self, transfer):
        """Sets the transfer functions: a list of one pair D(+,+), D(+,-) (C, Hy, Hx)."""
        ((d_plus, d_minus),) = transfer
        for i, plane in enumerate((d_plus.real, d_plus.imag, d_minus.real, d_minus.imag)):
            self._transfer[:, :, i, : plane.shape[2]] = plane
        if self.scratch:
            self.device.upload(self._transfer, self.scratch["transfer"])

    def reserve(self, n_images):
        """Allocates the intermediates of each core on the device, for any `n_images`."""
        if self.scratch:
            return
        plan, mapping, axes, put = self.plan, self.plan.mapping, self.plan.axes, self.device.put
        shape = tuple(mapping.shape_in[axis] for axis in axes)
        tables = [table[:, n // 2 :].T for table, n in zip((plan.in_y, plan.in_x), shape)]
        model = FoldedImages(self, shape, tables, [np.ones(n) for n in shape], axes)
        off = [np.arange(n // 2, n) - (n - 1) / 2 for n in mapping.shape_out]
        rates = [mapping.matrix[axes[i], i] for i in (0, 1)]
        tables = [wave_table(nu, rate * x) for nu, rate, x in zip(plan.nu, rates, off)]
        lit = [mapping.covered.any(axis=1 - i) for i in (0, 1)]
        observed = FoldedImages(self, mapping.shape_out, tables, lit, (0, 1))
        parts, lines, z = n_elements(plan, self.whole_vectors)
        work = self.device.empty((self.device.compute_units, parts + lines + z), np.float64)
        at = {"at_lines": parts, "at_z": parts + lines, "stride_scratch": work.shape[1]}
        held = {"transfer": put(self._transfer), "work": work}
        held |= {f"model {name}": array for name, array in model.tables.items()}
        held |= {f"observed {name}": array for name, array in observed.tables.items()}
        at |= {"D": held["transfer"], "scratch": work}
        self._forward = self._bound(model, observed, 1, at)
        self._adjoint = self._bound(observed, model, -1, at)
        self.scratch = held  # last, so that an interruption leaves a consistent state

    def forward(self, x: ImageBatch, y: ImageBatch, n, spread=False):
        """I2 from I1: x (n, Ny, Nx), or (n / n_bands, Ny, Nx) if `spread`, to y (n, My, Mx)."""
        self._queue(self._forward, x, y, n, self.plan.n_bands if spread else 1)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n, Ny, Nx)."""
        self._queue(self._adjoint, y, x, n, 1)

    def _queue(self, way, source: ImageBatch, target: ImageBatch, n, n_seen):
        """Queues forward or adjoint to `n` images, `n_seen` of them per input image."""
        launch, *all_axes = way
        given = {"n_sources": n // n_seen, "n_seen": n_seen}
        for name, images, axes in zip(("source", "target"), (source, target), all_axes):
            at = images.matrix(axes)
            given |= {name: at.buffer, f"{name}_offset": at.offset, f"{name}_stride": at.stride}
            given |= {f"{name}_ld": at.ld, f"{name}_step": at.step}
        launch((min(n // n_seen, self.device.compute_units), 1, 1), **given)

    def _bound(self, source: FoldedImages, target: FoldedImages, sign, shared):
        """The kernel of one way, and the axes of its images."""
        launch = self.device.launcher(
            "folded.cl",
            "folded",
            dtype=np.float64,
            local_size=(1, 1, 1),
            SIGN=sign,
            SPACED=(1, 0) in (source.axes, target.axes),
            **{name: self.tuning.tile[name] for name in ("VW", "NV", "MR")},
        ).bind(
            n_bands=self.plan.n_bands,
            h_y=len(self.plan.nu[0]),
            h_x=len(self.plan.nu[1]),
            h_pad=self.h_pad,
            **shared,
            **source.arguments("to"),
            **{f"to_{name}": value for name, value in target.arguments("from").items()},
        )
        return launch, source.axes, target.axes


class FoldedImages:
    """The images of one end of the operator, and waves about their middle.

    folded: the executor
    shape (2,) [px]: along the tables' axes, which are the images' `axes`
    both_waves (half_y, 2 Hy), (half_x, 2 Hx): at the pixels from the middle on, cos, sin in turn
    lit (n_y,), (n_x,): 0 for rows and columns to ignore, else 1
    tables: on the device, from pixels to frequencies and back
    """

    def __init__(self, folded: FoldedExecutor, shape, both_waves, lit, axes):
        self.axes, put = axes, folded.device.put
        half = [(n + 1) // 2 for n in shape]
        y, x = (np.stack([wave[:, 0::2], wave[:, 1::2]]) for wave in both_waves)  # (2, half, H)
        pad_x = folded.whole_vectors(half[1])
        self._sizes = {"n_y": shape[0], "n_x": shape[1], "pad_x": pad_x}
        self.tables = {
            "weight_y": put(_weights(shape[0], half[0], lit[0])),
            "weight_x": put(_weights(shape[1], half[1], lit[1])),
            "to wave_y": put(_turned(y)),
            "to wave_x": put(_padded(x, folded.h_pad)),
            "from wave_y": put(y),
            "from wave_x": put(_padded(_turned(x), pad_x)),
        }

    def arguments(self, way):
        """Arguments of the kernel for this side: "to" the frequencies or "from" them."""
        waves = {name: self.tables[f"{way} {name}"] for name in ("wave_y", "wave_x")}
        weights = {name: self.tables[name] for name in ("weight_y", "weight_x")}
        return self._sizes | weights | waves


def n_elements(plan: ResamplingPlan, whole_vectors=lambda n: n):
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
