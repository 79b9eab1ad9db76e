"""One scene to fit, with the state of its fit: what goes to the device, and what comes back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...resampling.resampler import Resampler


@dataclass(frozen=True)
class StepSizes:
    """Steps of the solver: `field` in units of the prior's scatter, `morphology` of its maximum,
    `spectrum` in units of a flux's error and 2 % of the flux (see Problem.scale)."""

    field: float = 0.1
    morphology: float = 0.01
    spectrum: float = 0.1


@dataclass(eq=False)
class Problem:
    """One scene with the state of its fit, on the host.

    shape (Ny, Nx) [px]: model frame
    extent (Ny, Nx) [px]: the part of it, from its first pixel on, that is not padding
    ops: one Resampler per observation, on one plan
    data, weights: per observation (Co, My, Mx)
    origin, shape_box, center (S, 2) [px]: boxes, inside the frame
    base (S): arrays (ny, nx) [1]: expected profile (max = 1)
    field, morph (S): arrays (ny, nx): z and S
    fixed (S): bool, the morphology stays as it is
    spectra, scale (S, C) [counts]: A and the step's natural size
    sky (C,) [counts]; fit_sky: whether it is free
    damping (S,): gradients under which steps are shorter than the rates; see `curvature.damping`
    moments: AMSGrad's m, v, h of the morphologies (S arrays each) and of the spectra; None to start
    n_steps: iterations done so far
    """

    shape: tuple[int, int]
    extent: tuple[int, int]
    ops: list[Resampler]
    data: list[np.ndarray]
    weights: list[np.ndarray]
    origin: np.ndarray
    center: np.ndarray
    base: list[np.ndarray]
    field: list[np.ndarray]
    morph: list[np.ndarray]
    fixed: np.ndarray
    spectra: np.ndarray
    scale: np.ndarray
    sky: np.ndarray
    damping: np.ndarray | None = None
    fit_sky: bool = False
    moments_morph: list[list[np.ndarray]] | None = None
    moments_spectra: np.ndarray | None = None
    n_steps: int = 0

    @property
    def signature(self):
        """Scenes of equal signature can share a batch."""
        return (
            self.shape,
            self.fit_sky,
            self.n_steps,
            tuple(
                (op.geometry, op.plans[0].axes, op.shape_out) + _lines(op.plans[0])
                for op in self.ops
            ),
        )


def _lines(plan):
    return (plan.lines.by_row,) if plan.lines is not None else ()
