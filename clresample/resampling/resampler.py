"""The operator: a model image on an instrument's pixels and PSF, exactly, with its adjoint."""

from __future__ import annotations

import math
import warnings

import numpy as np

from ..device.contraction import ImageBatch
from ..device.tuning import MAX_GROUPS
from ..sky.psf_checks import PSFWarning
from ..sky.validation.checks import check_dtype
from .affine import AffineExecutor
from .aligned import AlignedExecutor
from .distorted import DistortedExecutor
from .executor import Executor
from .folded import FoldedExecutor
from .grid_operator import GridOperator
from .plan import Precision, ResamplingPlan, make_resampling_plan
from .transfer import floor_warnings, gain_warnings

EXECUTORS = {"aligned": AlignedExecutor, "affine": AffineExecutor, "distorted": DistortedExecutor}


class Resampler(GridOperator):
    """Whittaker-Shannon resampling and PSF-difference convolution in one linear operator.

        I2(X) = K^-2 sum_nu D(nu) F[I1](nu) exp(2 pi i nu.X),  D = |det A| P2^(A^T nu) / P1^(nu)

    grid_in, psf_in, grid_out, psf_out, dtype, device, shift, tolerance_px, and the properties: see
    GridOperator.  `plans`: its tables, one plan, or one for each item of a batch.

    Raises ValueError for grids that do not overlap and for band counts that do not match.  Warns
    (PSFWarning) of a difference kernel that amplifies noise, and of a division that was floored.
    Source: eqs. `reconvampling2D`, `I2model` of the paper, summed in frequency space.
    """

    @classmethod
    def from_plans(
        cls, plans: list[ResamplingPlan], *, dtype=np.float32, device=None, shift=(0.0, 0.0)
    ) -> Resampler:
        """An operator on batches whose item b has its own geometry and PSFs, plans[b].

        plans: one for batches of any length, or one for each item; of equal geometry, axes, bands
            and shapes, and if affine, with lines along the same axis
        shift (2,) or (len(plans), 2) [model px]

        float32 operators sum in float32, so that batches of one plan and of many round alike.

        Raises ValueError for plans that differ in these properties.
        """
        _check_alike(plans)
        return cls._made(plans, dtype, device, shift, folds=False)

    @classmethod
    def _made(cls, plans, dtype, device, shift, folds):
        """An operator of plans; folds: a single plan may use float64, see FoldedExecutor."""
        op, dtype = cls.__new__(cls), check_dtype(dtype)
        op._take(plans, dtype, device, folds)
        op.shift = shift
        return op

    @classmethod
    def of_items(cls, ops: list[Resampler]) -> Resampler:
        """The operator of batches whose item b is rendered by ops[b].

        The same operator if all are one, else an operator of all their plans, at their present
        shifts.
        Raises ValueError if their layouts differ.
        """
        if all(op is ops[0] for op in ops):
            return ops[0]
        shifts = np.stack([op.shift for op in ops])
        plans = [op.plans[0] for op in ops]
        return cls.from_plans(plans, dtype=ops[0].dtype, device=ops[0].device, shift=shifts)

    @property
    def layout(self):
        """Properties that must be equal for operators to serve one batch: see from_plans."""
        return *self.plans[0].layout, self.shape_in, self.shape_out

    def _prepare(self, mapping, psf_in, psf_out, dtype, device):
        """The plan of a mapping, with its warnings, and its tables on the device."""
        plan = make_resampling_plan(mapping, psf_in, psf_out, precision=Precision.of(dtype))
        for message in gain_warnings(plan.certificate) + floor_warnings(plan.certificate):
            warnings.warn(message, PSFWarning, stacklevel=3)
        self._take([plan], dtype, device, folds=True)

    def _take(self, plans, dtype, device, folds):
        """Tables of all plans on the device."""
        n_bands, mappings = plans[0].n_bands, [plan.mapping for plan in plans]
        self._begin(device, dtype, n_bands, mappings, plans[0].n_terms)
        self.plans, self._certificates = plans, [plan.certificate for plan in plans]
        self._executor = EXECUTORS[self.geometry](self.device, self.dtype, plans)
        folds = folds and FoldedExecutor.is_preferred(self.device, self.dtype, plans[0])
        self._whole = FoldedExecutor(self.device, plans[0]) if folds else self._executor
        self._group = _images_at_once(self._executor) // n_bands or 1

    def _use_shift(self):
        """Uploads D with the phases of the shift."""
        self._identity = all(p.identity for p in self.plans) and not self._shift.any()
        pairs = zip(self.plans, self._shift, strict=True)
        transfer = [plan.shifted(shift) for plan, shift in pairs]
        for executor in {self._executor, self._whole}:
            executor.set_transfer(transfer)

    def __reduce__(self):
        """Copied and pickled as its plans; the copy uploads them to the device of the same name."""
        folds = self._whole is not self._executor
        return type(self)._made, (self.plans, self.dtype, self.device, self._shift, folds)

    def executor(self) -> Executor:
        """Executor with intermediates of its own; for callers that work between stages."""
        return self._executor.clone()

    @property
    def is_identity(self) -> bool:
        """True if it returns its input bit for bit: same pixels, same PSF, no shift."""
        return self._identity

    @property
    def n_bytes(self) -> int:
        """Device memory of tables, intermediates and arrays for NumPy callers [bytes], roughly."""
        # each table in the operator's type, the way it is used forward and the way back
        tables = 2 * sum(plan.n_bytes for plan in self.plans) * self.dtype.itemsize // 8
        with self._lock:
            held = [a for e in {self._executor, self._whole} for a in e.scratch.values()]
            held += [array for staged in self._staged.values() for array in staged[1:]]
        return tables + sum(getattr(array, "nbytes", 0) for array in held)

    def render(self, x, out=None):
        """One image seen in every band: x (Ny, Nx) -> (C, My, Mx), or batches of both.

        Into `out` (of x's kind) if given. Raises ValueError as `forward` does, and with terms.
        """
        if self.n_terms > 1:
            raise ValueError(f"n_terms is {self.n_terms}, `render` takes operators of one term")
        return self._apply(self._render, "x", x, out, self.shape_in[1:], self.shape_out)

    def _render(self, x, out):
        """`render` on device arrays (B, Ny, Nx) and (B, C, My, Mx)."""
        self._run("forward", x, out, spread=True)

    def _forward(self, x, out):
        """I2 of device arrays: x (B, C, Ny, Nx), out (B, C, My, Mx)."""
        self._run("forward", x, out)

    def _adjoint(self, y, out):
        """R^T y of device arrays: y (B, C, My, Mx), out (B, C, Ny, Nx)."""
        self._run("adjoint", y, out)

    def queue_plain(self, way, source, target):
        """Queues "forward" or "adjoint" like `forward_into`, in the operator's own type throughout.

        For float32 images that `forward_into` computes in float64, this takes two thirds of the
        time.
        """
        with self._lock:
            self._run(way, source, target, whole=self._executor)

    def _run(self, way, source, target, *, whole=None, **options):
        """Queues "forward" or "adjoint" on as many items at a time as the cache holds.

        source, target: device arrays (B,) + shape of an item; whole: the executor, None = that of
            `forward`; options: of `way`
        """
        batch, whole = source.shape[0], whole or self._whole
        if len(self.plans) not in (1, batch):
            raise ValueError(f"the batch has {batch} items, the operator {len(self.plans)} plans")
        if self._identity and not options:
            self.device.copy(source, target)
            return
        # items with tables of their own need one launch, since tables are counted from its first
        # item; a folded executor needs one too, since its intermediates are those of the cores
        grouped = len(self.plans) == 1 and whole is self._executor
        group = min(self._group, batch) if grouped else batch
        _queue(whole, way, source, target, group, self.plans[0].n_bands, **options)


def _queue(executor, way, source, target, group, n_bands, **options):
    """Queues the items of device arrays, `group` at a time; see `Resampler._run`."""
    executor.reserve(group * n_bands)
    for start in range(0, len(source), group):
        n = min(group, len(source) - start) * n_bands
        images = (ImageBatch.of(a, start * math.prod(a.shape[1:-2])) for a in (source, target))
        getattr(executor, way)(*images, n, **options)


def _images_at_once(executor: Executor) -> int:
    """Largest number of images of one launch: their intermediates must fit the cache."""
    per_image = sum(rows * ld for rows, ld in executor.scratch_shapes().values())
    fit = executor.tuning.group_bytes // (per_image * np.dtype(executor.dtype).itemsize)
    return min(fit, MAX_GROUPS // executor.n_terms)


def _check_alike(plans):
    """ValueError unless these plans can serve one batch."""
    if not plans:
        raise ValueError("plans is empty, at least one is needed")
    first = plans[0]
    for i, plan in enumerate(plans):
        for name in ("geometry", "axes", "n_bands", "n_terms", "shape_in", "shape_out"):
            found, expected = (
                getattr(p.mapping if name.startswith("shape") else p, name) for p in (plan, first)
            )
            if found != expected:
                raise ValueError(f"plans[{i}] has {name} {found}, plans[0] has {expected}")
        if plan.lines is not None and plan.lines.by_row != first.lines.by_row:
            along = {True: "rows", False: "columns"}
            raise ValueError(
                f"plans[{i}] runs along the observed {along[plan.lines.by_row]}, "
                f"plans[0] along the {along[first.lines.by_row]}: give those "
                "turned by more than 45 degrees their own operator"
            )
