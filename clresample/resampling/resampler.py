"""The operator: a model image on an instrument's pixels and PSF, exactly, with its adjoint."""

from __future__ import annotations

import functools
import math
import warnings

import numpy as np

from ..device.contraction import ImageBatch
from ..sky.grid import Grid
from ..sky.psf import PSF
from ..sky.psf_checks import PSFWarning
from .affine import AffineExecutor
from .aligned import AlignedExecutor
from .distorted import DistortedExecutor
from .linop import LinOp
from .plan import Plan, Precision, make_plan
from .transfer import DIVISION_FLOOR

PATHS = {"aligned": AlignedExecutor, "affine": AffineExecutor, "distorted": DistortedExecutor}
# Amplification |D| / |det A| worth telling, above the few per cent of PSFs that nearly agree, and
# the share of the observed PSF's power that the floor of the division may take untold.
NOISY_GAIN, FLOORED_POWER = 2.0, 1e-3


class Resampler(LinOp):
    """Whittaker-Shannon resampling and PSF-difference convolution in one linear operator.

        I2(X) = K^-2 sum_nu D(nu) F[I1](nu) exp(2 pi i nu.X),  D = |det A| P2^(A^T nu) / P1^(nu)

    grid_in, grid_out (Grid): pixels of the model and of the observation
    psf_in (1 or C bands), psf_out (1 or C bands): their PSFs, each in its own grid's pixels
    dtype: float32, or float64 where the device has it
    shift (2,) [model px]: moves every observed pixel; may be set again at any time
    tolerance_px [model px]: departures up to this count as none when the path is chosen

    Images are flux per pixel, (C, Ny, Nx) or (B, C, Ny, Nx).  Observed pixels whose centre the
    model does not cover come out as 0; `covered` (My, Mx) tells which are covered, `kind` the path
    taken, `report` what the set-up found.
    Raises ValueError for grids that do not overlap and for band counts that do not match.  Warns
    (PSFWarning) of a difference kernel that amplifies noise, and of a division that was floored.
    Source: eqs. `reconvampling2D`, `I2model` of the paper, summed in frequency space.
    """

    def __init__(
        self,
        grid_in: Grid,
        psf_in: PSF,
        grid_out: Grid,
        psf_out: PSF,
        *,
        dtype=np.float32,
        device=None,
        shift=(0.0, 0.0),
        tolerance_px=1e-4,
    ):
        mapping = grid_out.map_to(grid_in, tolerance_px=tolerance_px)
        plan = make_plan(mapping, psf_in, psf_out, precision=Precision.of(dtype))
        for message in noise_warnings(plan.report):
            warnings.warn(message, PSFWarning, stacklevel=2)
        self._setup([plan], dtype, device, shift)

    @classmethod
    def from_plans(
        cls, plans: list[Plan], *, dtype=np.float32, device=None, shift=(0.0, 0.0)
    ) -> Resampler:
        """An operator on batches whose item b has its own geometry and PSFs, plans[b].

        plans: one for batches of any length, or one for each item; alike in kind, axes, bands,
            shapes and, when affine, in whether lines are rows
        shift (2,) or (len(plans), 2) [model px]
        Raises ValueError for plans that differ in these.
        """
        if not plans:
            raise ValueError("plans is empty, at least one is needed")
        for i, plan in enumerate(plans):
            for name in ("kind", "axes", "n_bands"):
                if getattr(plan, name) != getattr(plans[0], name):
                    raise ValueError(
                        f"plans[{i}] has {name} {getattr(plan, name)}, "
                        f"plans[0] has {getattr(plans[0], name)}"
                    )
            for name in ("shape_in", "shape_out"):
                if getattr(plan.mapping, name) != getattr(plans[0].mapping, name):
                    raise ValueError(
                        f"plans[{i}] has {name} {getattr(plan.mapping, name)}, "
                        f"plans[0] has {getattr(plans[0].mapping, name)}"
                    )
            if plan.lines is not None and plan.lines.by_row != plans[0].lines.by_row:
                along = {True: "rows", False: "columns"}
                raise ValueError(
                    f"plans[{i}] runs along the observed {along[plan.lines.by_row]}, "
                    f"plans[0] along the {along[plans[0].lines.by_row]}: give those "
                    "turned by more than 45 degrees their own operator"
                )
        op = cls.__new__(cls)
        op._setup(plans, dtype, device, shift)
        return op

    def _setup(self, plans, dtype, device, shift):
        first = plans[0]
        super().__init__(
            device,
            dtype,
            (first.n_bands, *first.mapping.shape_in),
            (first.n_bands, *first.mapping.shape_out),
        )
        self.plans, self.kind = plans, first.kind
        self._path = PATHS[first.kind](self.device, self.dtype, plans)
        per_image = sum(rows * ld for rows, ld in self._path.scratch_shapes().values())
        budget = self._path.tuning.group_bytes
        self._group = max(1, budget // (per_image * self.dtype.itemsize * first.n_bands))
        self.shift = shift

    @property
    def shift(self):
        """Offset (len(plans), 2) [model px] by which every observed pixel is moved."""
        return self._shift

    @shift.setter
    def shift(self, shift):
        shift, expected = np.asarray(shift, np.float64), (len(self.plans), 2)
        if shift.shape not in ((), (2,), expected) or not np.isfinite(shift).all():
            raise ValueError(f"shift is {shift}, must be (2,) or {expected} finite numbers")
        self._shift = np.broadcast_to(shift, expected).copy()
        self._shift.flags.writeable = False  # a change must come through this setter
        self._identity = all(p.identity for p in self.plans) and not self._shift.any()
        transfer = [p.shifted(s) for p, s in zip(self.plans, self._shift, strict=True)]
        self._path.set_transfer(transfer)

    @property
    def covered(self):
        """Observed pixels (My, Mx) whose centre lies on the model; a mask per plan of many."""
        masks = [p.mapping.covered for p in self.plans]
        return masks[0] if len(masks) == 1 else np.stack(masks)

    @property
    def report(self):
        """What the set-up found (see Plan.report); a list where there are many plans."""
        reports = [p.report for p in self.plans]
        return reports[0] if len(reports) == 1 else reports

    def render(self, x, out=None):
        """One image seen in every band: x (Ny, Nx) -> (C, My, Mx), or batches of both."""
        return self._apply(self._render, "x", x, out, self.shape_in[1:], self.shape_out)

    def _render(self, x, out):
        self._run(
            functools.partial(self._path.forward, spread=True),
            x,
            out,
            (1, *x.shape[1:]),
            self.shape_out,
            identity=False,
        )

    def _forward(self, x, out):
        self._run(self._path.forward, x, out, self.shape_in, self.shape_out)

    def _adjoint(self, y, out):
        self._run(self._path.adjoint, y, out, self.shape_out, self.shape_in)

    def _run(self, chain, source, target, shape_source, shape_target, identity=True):
        batch = source.shape[0]
        if len(self.plans) not in (1, batch):
            raise ValueError(f"the batch has {batch} items, the operator {len(self.plans)} plans")
        if identity and self._identity:
            self.device.copy(source, target)
            return
        n_bands = self.plans[0].n_bands
        # per-item tables are counted from a launch's first item, so they go in one group
        group = min(self._group, batch) if len(self.plans) == 1 else batch
        self._path.reserve(group * n_bands)
        for start in range(0, batch, group):
            n = min(group, batch - start) * n_bands
            chain(
                ImageBatch.of(source, start * math.prod(shape_source[:-2])),
                ImageBatch.of(target, start * math.prod(shape_target[:-2])),
                n,
            )


def noise_warnings(report):
    """What a user should know of a difference kernel that does more than blur, a line each."""
    gain, floored = report["max_gain"].max(), report["floored_power"].max()
    told = []
    if gain > NOISY_GAIN:
        told.append(
            f"the difference kernel amplifies some frequencies {gain:.3g} times, and noise "
            "with them: the model's PSF is wider there than the observation's"
        )
    if floored > FLOORED_POWER:
        told.append(
            f"{floored:.2%} of the observed PSF's power lies where the model's carries less "
            f"than {DIVISION_FLOOR:g} of its light: the division is floored there"
        )
    return told
