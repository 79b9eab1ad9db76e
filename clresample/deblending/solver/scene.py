"""One scene to fit, on the host: constants (Scene) and iterated variables (State)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...resampling.resampler import Resampler
from ..linear.ties import Ties


@dataclass(frozen=True, eq=False)
class Scene:
    """Constants of the iterations of one scene: data, operators, boxes, expected profiles.

    Fitted shifts change the operators, and boxes that follow their light make another Scene.

    S sources, C channels of all observations in their order, Co of observation o.

    shape (Ny, Nx) [px]: model frame
    unpadded_shape (Ny, Nx) [px]: the part of it, from its first pixel on, that is not padding
    ops: one Resampler per observation, each at its observation's present shift
    data, weights: per observation (Co, My, Mx)
    origin, center (S, 2) [px]: first pixel of each box in the frame, which holds all of the box,
        and the pixel of the box about which the morphology falls
    profile (S): arrays (ny, nx) [1]: expected morphology, max = 1
    fixed (S,): bool, the morphology stays as it is
    coefficients: per observation (S, Co, T), of its operator's terms in each component's PSF; None
        if its PSF is the same for all
    spectrum_curvature (S, C): sum w (R p)^2 of each profile p, the curvature of the loss by its
        spectrum
    fit_sky: whether the sky level of each channel is free
    sky_precision (C,): inverse variance of the prior of a fitted sky level, whose mean is 0 because
        the expected level was subtracted from the data; 0 without an expectation; None = 0 in all
        channels
    ties: Ties of the channels; None if each has its own band
    """

    shape: tuple[int, int]
    unpadded_shape: tuple[int, int]
    ops: list[Resampler]
    data: list[np.ndarray]
    weights: list[np.ndarray]
    origin: np.ndarray
    center: np.ndarray
    profile: list[np.ndarray]
    fixed: np.ndarray
    coefficients: list | None = None
    spectrum_curvature: np.ndarray | None = None
    fit_sky: bool = False
    sky_precision: np.ndarray | None = None
    ties: Ties | None = None

    def channels(self) -> list[slice]:
        """For each observation, its part of the channels."""
        ends = np.cumsum([op.shape_out[0] for op in self.ops]).tolist()
        return [slice(end - op.shape_out[0], end) for op, end in zip(self.ops, ends, strict=True)]

    def shares_of(self, i):
        """Observation i's shares (S, Co, T) or None."""
        return self.coefficients[i] if self.coefficients else None

    @property
    def known_sky(self) -> np.ndarray:
        """`sky_precision` (C,), 0 without one or where the sky is not fitted."""
        if self.sky_precision is None or not self.fit_sky:
            return np.zeros(sum(op.shape_out[0] for op in self.ops))
        return self.sky_precision

    def parts(self, i, spectra):
        """Spectra (S, Co) of observation i as its operator takes them, (S, Co T)."""
        shares = self.shares_of(i)
        if shares is None:
            return spectra
        return (spectra[:, :, None] * shares).reshape(len(spectra), -1)

    @property
    def n_bytes(self) -> int:
        """Device memory [bytes] that the scene takes in a batch, roughly.

        All numbers as float64, `image_numbers` and twelve arrays for each box.
        """
        return 8 * (image_numbers(self.ops) + 12 * sum(m.size for m in self.profile))


@dataclass(frozen=True, eq=False)
class StructureState:
    """Structure of one scene's n components in a fit under a MultiscalePrior.

    structure [s][j] (ny_j, nx_j): coefficients z of each scale, on the grids of `LatentLayout`
    strengths (n, J): their scatter; clear (n,): bool, significant structure, see evidence.py. Both
        are meaningless for fixed components
    """

    structure: list[list[np.ndarray]]
    strengths: np.ndarray
    clear: np.ndarray


@dataclass(frozen=True, eq=False)
class ComponentStructure:
    """Structure of one component about its profile, from which another fit may go on.

    origin (2,) [px]: first pixel of its box in the frame
    coefficients (J): arrays z (ny_j, nx_j) of the scales in that box, see StructureState
    strengths (J,), clear: see StructureState
    """

    origin: tuple[int, int]
    coefficients: tuple[np.ndarray, ...]
    strengths: np.ndarray
    clear: bool


@dataclass(frozen=True, eq=False)
class State:
    """Variables of the iterations of one scene.

    morph (S): arrays (ny, nx), S
    spectra (S, C): A, and sky (C,), in the unit of the data
    learned: StructureState with a MultiscalePrior; None = no structure, the prior's strengths
    """

    morph: list[np.ndarray]
    spectra: np.ndarray
    sky: np.ndarray
    learned: StructureState | None = None


def image_numbers(ops) -> int:
    """Numbers of a scene's images on the device in a batch: 2 of the model, 7 of each channel.

    Data, weights and their roots stay there as long as the fit; data and weights are copied for a
    smaller batch; residuals and rendered images change.
    """
    return int(sum(2 * np.prod(op.shape_in) + 7 * np.prod(op.shape_out) for op in ops))


def signature_of(shape, fit_sky, ops, ties):
    """Signature of scenes: equal for those that can share a batch.

    It holds frames, observed shapes and kernels to run.
    """
    return shape, fit_sky, tuple(op.layout for op in ops), ties
