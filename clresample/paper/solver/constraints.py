"""Constraints on morphologies as operators on the device, over all sources of a batch.

Each has `prox(morphs, boxes, *, step=1.0, active=None, factor=None)`, which overwrites morphs:

morphs (boxes.size,): pyopencl array, float32 or float64, laid out by `boxes` (a DeviceBoxes)
step: of the gradient descent that the operator follows; multiplies penalties, not constraints
active: the sources to change (see DeviceBoxes.active); others are unchanged, at no cost
factor (S,): device array of morphs' type or None; receives the divisor of each active source's
    normalisation (1 without one): the spectrum times this factor leaves the model unchanged

Parameters are numbers, or arrays (S,) with one value per source. The NumPy references are in
reference.py; sources: Parikh & Boyd 2014, Melchior et al. 2018 (arXiv:1802.10157) and 2019
(arXiv:1910.10094).
"""

from __future__ import annotations

import enum
import itertools
import weakref

import numpy as np

from .prox_launches import MAX_STEPS, FusedSteps

__all__ = [
    "ProxChain",
    "L0",
    "L1",
    "MaxNorm",
    "Monotone",
    "Positivity",
    "SumNorm",
    "Symmetry",
]


class MonotoneWeights(enum.IntEnum):
    """Weights of the neighbours nearer to the centre, for a monotone morphology.

    ANGLE: by the cosine of the angle between the ways to the neighbour and to the centre;
    FLAT: all alike; NEAREST: the one of the largest cosine alone; OFF: not monotone at all
    """

    OFF = 0
    ANGLE = 1
    FLAT = 2
    NEAREST = 3


class Prox:
    """An operator with the kernels of `_launches`, compiled once per boxes and type.

    parameters: by name, as passed
    name (of those that are steps): of the step in prox.cl
    """

    def __init__(self, **parameters):
        self.parameters = parameters
        self._bound = weakref.WeakKeyDictionary()

    def __getstate__(self):
        """State for copies, without the parts bound to a device."""
        return {**self.__dict__, "_bound": None}

    def __setstate__(self, state):
        self.__dict__.update(state, _bound=weakref.WeakKeyDictionary())

    def __repr__(self):
        values = ", ".join(f"{name}={value!r}" for name, value in self.parameters.items())
        return f"{type(self).__name__}({values})"

    def prox(self, morphs, boxes, *, step=1.0, active=None, factor=None):
        """Overwrites morphs by the operator's result; see the module's text.

        Raises ValueError if morphs or factor have another shape or type than the boxes require.
        """
        n_sources = len(boxes)
        if morphs.shape != (boxes.boxes.size,):
            raise ValueError(f"morphs is {morphs.shape}, the boxes take ({boxes.boxes.size},)")
        if factor is not None and (factor.shape, factor.dtype) != ((n_sources,), morphs.dtype):
            raise ValueError(
                f"factor is {factor.shape} {factor.dtype}, must be ({n_sources},) {morphs.dtype}"
            )
        active = boxes.active(active)
        if active.size == 0:
            return
        bound = self._bound.setdefault(boxes, {})
        if morphs.dtype not in bound:
            bound[morphs.dtype] = self._launches(boxes, morphs.dtype)
        for i_launch, launch in enumerate(bound[morphs.dtype]):
            launch(morphs, active, step, factor, i_launch == 0)

    def steps(self):
        """The operators that are one step of prox.cl each."""
        return [self]

    def values(self):
        """The two parameters of the step, each {its name: number or (S,)} or empty."""
        return {"on": 1}, {}

    def _launches(self, boxes, dtype):
        """Kernel launches, in order, for boxes and morphologies of a type."""
        return [FusedSteps(self.steps(), boxes, dtype)]


class Positivity(Prox):
    """The projection onto x >= 0: max(x, 0)."""

    name = "positivity"


class L1(Prox):
    """Soft threshold, the prox of strength * sum |x|: sign(x) max(|x| - step * strength, 0).

    strength: number or (S,) [unit of the loss / pixel value], 0 leaves the source alone
    """

    name = "soft"

    def __init__(self, strength):
        super().__init__(strength=strength)

    def values(self):
        """The threshold for a step of 1."""
        return {"strength": _at_least_0("strength", self.parameters["strength"])}, {}


class L0(L1):
    """Hard threshold, the prox of strength * (number of x != 0): 0 where x^2 <= 2 step strength.

    strength: number or (S,) [unit of the loss], 0 leaves the source alone
    """

    name = "hard"


class Symmetry(Prox):
    """Towards the mirror image about the centre pixel: x - strength (x - x_mirror) / 2.

    Pixels whose mirror lies outside the box are left alone.
    strength: number or (S,) between 0 (nothing) and 1, the projection onto symmetric images;
        between, the prox of k/2 |antisymmetric part|^2 with strength = k / (1 + k)
    """

    name = "symmetry"

    def __init__(self, strength=1.0):
        super().__init__(strength=strength)

    def values(self):
        """The fraction of the antisymmetric part that is subtracted."""
        return {"strength": _at_least_0("strength", self.parameters["strength"], 1)}, {}


class MaxNorm(Prox):
    """x / max(x), or x where the maximum is not positive. A choice of scale, not a prox."""

    name = "max_norm"


class SumNorm(Prox):
    """x / sum(x), or x where the sum is not positive. A choice of scale, not a prox."""

    name = "sum_norm"


class Monotone(Prox):
    """The monotone sweep, outward from the centre: x_i <- min(x_i, (1-g) sum_j w_ij x_j).

    j runs over the neighbours (of 8) nearer to the centre. A heuristic, not a projection: it only
    lowers pixels, so noise biases it low.
    weights: of MonotoneWeights, one or (S,); gradient: g, number or (S,), 0 <= g < 1
    """

    name = "monotone"

    def __init__(self, *, weights=MonotoneWeights.ANGLE, gradient=0.0):
        super().__init__(weights=weights, gradient=gradient)

    def values(self):
        """Weights of neighbours, and the smallest relative fall per pixel."""
        weights = np.asarray(self.parameters["weights"])
        if not np.isin(weights, list(MonotoneWeights)).all():
            raise ValueError(f"weights is {weights}, must be {[str(w) for w in MonotoneWeights]}")
        gradient = self.parameters["gradient"]
        return {"weights": weights}, {"gradient": _at_least_0("gradient", gradient, 1)}


class ProxChain(Prox):
    """Applies operators in turn, 8 of them in a launch."""

    def __init__(self, *proxes):
        super().__init__()
        self._proxes = proxes

    def __repr__(self):
        return f"ProxChain({', '.join(map(repr, self._proxes))})"

    def steps(self):
        """The steps of all of them, in order."""
        return list(itertools.chain.from_iterable(prox.steps() for prox in self._proxes))

    def _launches(self, boxes, dtype):
        """A launch for every MAX_STEPS steps."""
        steps = self.steps()
        return [
            FusedSteps(steps[k : k + MAX_STEPS], boxes, dtype)
            for k in range(0, len(steps), MAX_STEPS)
        ]


def _at_least_0(name, value, most=np.inf):
    """A parameter as an array; ValueError unless it lies between 0 and `most`."""
    value = np.asarray(value)
    if not ((value >= 0) & (value <= most)).all():
        raise ValueError(f"{name} is {value}, must be between 0 and {most}")
    return value
