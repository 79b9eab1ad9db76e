"""Constants and variables of AMSGrad's iterations of one scene, beside those of every solver."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ...deblending.solver.scene import Scene, State
from .curvature import damping

# A spectrum's step size counts in errors of the flux plus this part of the flux: bright sources,
# whose errors are far smaller than what a changing morphology does to their flux, can follow it.
SPECTRUM_PART = 0.02
# Least power sum |u|^2 of a component's whitened image u in a channel, whose root is the inverse of
# its spectrum's error; and the error from which on the channel holds nothing of the component, so
# that its spectrum is not stepped there. A covered component has errors of 1e6 at most.
MIN_POWER, UNSEEN = 1e-30, 1e14


@dataclass(frozen=True, eq=False)
class AmsgradMoments:
    """Moments of AMSGrad: k arrays like the morphologies and the spectra.

    morph (k): each S arrays (ny, nx), in the boxes; spectra (k, S, C)
    """

    morph: list[list[np.ndarray]]
    spectra: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class AmsgradScene(Scene):
    """A Scene, and the lengths of steps in it.

    step_scale (S, C): what counts as one step of each spectrum, in the unit of the data
    damping (S,): gradients under which steps are shorter than the step sizes; see
        `curvature.damping`
    """

    step_scale: np.ndarray
    damping: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class AmsgradState(State):
    """A State, and what AMSGrad remembers.

    latent (S): arrays (ny, nx), z (see SingleScalePrior; of no use without one)
    memory: of the update, None before its first step; n_steps: iterations done so far
    """

    latent: list[np.ndarray]
    memory: AmsgradMoments | None = None
    n_steps: int = 0


def begin_steps(scene, state, prior) -> tuple[AmsgradScene, AmsgradState]:
    """A Scene and State at the start as AMSGrad takes them; those of its own as they are.

    prior: the SingleScalePrior, or None
    """
    if isinstance(state, AmsgradState):
        return scene, state
    power, ties = scene.spectrum_curvature, scene.ties
    together = power if ties is None else ties.spread(ties.total(power))
    error = 1 / np.sqrt(np.maximum(together, MIN_POWER))
    return (
        AmsgradScene(
            **_fields(scene),
            step_scale=np.where(error < UNSEEN, error + SPECTRUM_PART * state.spectra, 0),
            damping=damping(scene, state, prior),
        ),
        AmsgradState(**_fields(state), latent=[np.zeros_like(m) for m in state.morph]),
    )


def _fields(one):
    return {field.name: getattr(one, field.name) for field in fields(one)}
