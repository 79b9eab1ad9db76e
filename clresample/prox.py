"""Constraints on morphologies as operators on the device, over all sources of all scenes at once.

Each has `prox(morphs, boxes, *, step=1.0, active=None, factor=None)`, which overwrites morphs:

morphs (boxes.size,): pyopencl array, float32 or float64, laid out by `boxes` (a DeviceBoxes)
step: of the gradient descent that the operator follows; multiplies penalties, not constraints
active: the sources to treat (see DeviceBoxes.active); the others stay as they are, at no cost
factor (S,): device array of morphs' type or None; what the normalisations divided each active
    source by (1 without one): multiply the spectrum by it, and the model stays

Parameters are numbers, or arrays (S,) with one value per source. The NumPy references are in
reference_prox.py; sources: Parikh & Boyd 2014, Melchior et al. 2018 (arXiv:1802.10157) and 2019
(arXiv:1910.10094).
"""

from __future__ import annotations

import itertools
import weakref

import numpy as np

from .boxes import ALIGN, Weights

__all__ = [
    "L0",
    "L1",
    "Chain",
    "MaxNorm",
    "Monotone",
    "MonotoneProjection",
    "Positivity",
    "SumNorm",
    "Symmetry",
]

# Work-items a source: on a CPU one, with no barriers; on a GPU as many as every GPU allows.
GROUP = {"CPU": 1}
GROUP_ELSEWHERE = 64
# STEP0 .. STEP7 of prox.cl.
MOST_STEPS = 8


class Prox:
    """An operator; what is done is set by `_launches`, compiled once per boxes and type."""

    def __init__(self, **parameters):
        self._parameters = parameters
        self._bound = weakref.WeakKeyDictionary()

    def __repr__(self):
        values = ", ".join(f"{name}={value!r}" for name, value in self._parameters.items())
        return f"{type(self).__name__}({values})"

    def prox(self, morphs, boxes, *, step=1.0, active=None, factor=None):
        """Overwrite morphs by the operator's answer; see the module's text.

        ValueError: morphs or factor have another shape or type than the boxes ask for
        """
        n_sources = len(boxes)
        if morphs.shape != (boxes.boxes.size,):
            raise ValueError(f"morphs is {morphs.shape}, the boxes take ({boxes.boxes.size},)")
        if factor is not None and (factor.shape, factor.dtype) != ((n_sources,), morphs.dtype):
            raise ValueError(
                f"factor is {factor.shape} {factor.dtype}, it takes ({n_sources},) {morphs.dtype}"
            )
        active = boxes.active(active)
        if active.size == 0:
            return
        bound = self._bound.setdefault(boxes, {})
        if morphs.dtype not in bound:
            bound[morphs.dtype] = self._launches(boxes, morphs.dtype)
        for i_launch, launch in enumerate(bound[morphs.dtype]):
            launch(morphs, active, step, factor, i_launch == 0)

    def _steps(self):
        """The operators that are one step of prox.cl each, or stand alone."""
        return [self]

    def _values(self):
        """The two parameters of the step, each {its name: number or (S,)} or empty."""
        return {"on": 1}, {}

    def _launches(self, boxes, dtype):
        return [_Fused(self._steps(), boxes, dtype)]


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

    def _values(self):
        return {"strength": _at_least_0("strength", self._parameters["strength"])}, {}


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

    def _values(self):
        return {"strength": _at_least_0("strength", self._parameters["strength"], 1)}, {}


class MaxNorm(Prox):
    """x / max(x), or x where the maximum is not positive. A choice of scale, not a prox."""

    name = "max_norm"


class SumNorm(Prox):
    """x / sum(x), or x where the sum is not positive. A choice of scale, not a prox."""

    name = "sum_norm"


class Monotone(Prox):
    """The monotone sweep, outward from the centre: x_i <- min(x_i, (1-g) sum_j w_ij x_j).

    j runs over the neighbours (of 8) nearer to the centre. A heuristic, not a projection: it only
    lowers pixels, so noise biases it low; MonotoneProjection projects onto the same images.
    weights: a Weights, or (S,) of them; gradient: g, number or (S,), 0 <= g < 1
    """

    name = "monotone"

    def __init__(self, *, weights=Weights.ANGLE, gradient=0.0):
        super().__init__(weights=weights, gradient=gradient)

    def _values(self):
        weights = np.asarray(self._parameters["weights"])
        if not np.isin(weights, list(Weights)).all():
            raise ValueError(f"weights is {weights}, it takes {[str(w) for w in Weights]}")
        gradient = self._parameters["gradient"]
        return {"weights": weights}, {"gradient": _at_least_0("gradient", gradient, 1)}


class MonotoneProjection(Monotone):
    """The monotone image nearest to x: the projection onto the cone of the sweep's images.

    min 1/2 |z - x|^2  with  z_i <= (1-g) sum_j w_ij z_j  for all i but the centre, z >= 0

    By accelerated ascent of the dual (kernels/project.cl), then a sweep that makes it exactly
    monotone. The dual is kept from call to call for each boxes and type, so that the calls of a
    fit, whose images differ little, start nearly done; that takes 15 numbers a pixel.
    positive: whether z >= 0 is asked for
    n_iterations: at most so many a call; tolerance: a call ends when an iteration moves the dual
        by less than this part of |x|. As given, a galaxy in noise comes out within 1e-4 |x| at
        41 x 41 pixels, 1e-3 |x| at 101 x 101
    """

    def __init__(
        self,
        *,
        weights=Weights.ANGLE,
        gradient=0.0,
        positive=True,
        n_iterations=300,
        tolerance=1e-5,
    ):
        super().__init__(weights=weights, gradient=gradient)
        self._parameters |= {
            "positive": positive,
            "n_iterations": n_iterations,
            "tolerance": tolerance,
        }

    def _launches(self, boxes, dtype):
        sweep = Monotone(weights=self._parameters["weights"], gradient=self._parameters["gradient"])
        return [_Projection(self, boxes, dtype), _Fused([sweep], boxes, dtype)]


class Chain(Prox):
    """One operator after the other, the first first; in one launch where none is a projection."""

    def __init__(self, *proxes):
        super().__init__()
        self._proxes = proxes

    def __repr__(self):
        return f"Chain({', '.join(map(repr, self._proxes))})"

    def _steps(self):
        return list(itertools.chain.from_iterable(prox._steps() for prox in self._proxes))

    def _launches(self, boxes, dtype):
        launches = []
        for alone, steps in itertools.groupby(self._steps(), _stands_alone):
            if alone:
                launches += [launch for s in steps for launch in s._launches(boxes, dtype)]
            else:
                steps = list(steps)
                launches += [
                    _Fused(steps[k : k + MOST_STEPS], boxes, dtype)
                    for k in range(0, len(steps), MOST_STEPS)
                ]
        return launches


class _Fused:
    """Up to 8 steps on some boxes: the two kernels of prox.cl with all that stays set."""

    def __init__(self, steps, boxes, dtype):
        self.device, n = boxes.device, len(boxes)
        self.group = GROUP.get(self.device.kind, GROUP_ELSEWHERE)
        values = np.array([_table(step, n) for step in steps])
        self.arrays = boxes.table, self.device.put(values, dtype)
        names = {f"STEP{k}": step.name for k, step in enumerate(steps)}
        self.real = np.dtype(dtype).type
        self.kernels = []
        for kernel in ("chain", "chain_factor"):
            kernel = self.device.kernel("prox.cl", kernel, dtype=dtype, WG=self.group, **names)
            kernel.set_arg(1, self.arrays[0].data)
            kernel.set_arg(3, self.arrays[1].data)
            kernel.set_arg(4, np.int32(n))
            self.kernels.append(kernel)

    def __call__(self, morphs, active, step, factor, first):
        kernel = self.kernels[factor is not None]
        kernel.set_arg(0, morphs.data)
        kernel.set_arg(2, active.data)
        kernel.set_arg(5, self.real(step))
        if factor is not None:
            kernel.set_arg(6, factor.data)
            kernel.set_arg(7, np.int32(first))
        self.device.launch(kernel, (active.size * self.group,), (self.group,))


class _Projection:
    """project.cl on some boxes, with its dual and its scratch."""

    def __init__(self, prox, boxes, dtype):
        device, n = boxes.device, len(boxes)
        self.device, self.group = device, GROUP.get(device.kind, GROUP_ELSEWHERE)
        planes = -(-(boxes.boxes.shape.astype(np.int64) + 2).prod(1) // ALIGN)
        pads = device.put(np.concatenate([[0], np.cumsum(planes)])[:-1], np.int32)
        size = int(planes.sum()) * ALIGN
        values = device.put(_table(prox, n), dtype)
        w = device.zeros(8 * size, dtype)
        tau, y, dual, v, z, g, move = (device.zeros(size, dtype) for _ in range(7))
        real = np.dtype(dtype).type
        macros = {"dtype": dtype, "WG": self.group}
        weigh = device.kernel("project.cl", "project_weights", **macros)
        arrays = w, tau, z, boxes.table, pads, boxes.everyone, values
        weigh.set_args(*(array.data for array in arrays), np.int32(n))
        device.launch(weigh, (n * self.group,), (self.group,))
        self.kernel = device.kernel("project.cl", "project", **macros)
        self.arrays = boxes.table, pads, None, w, tau, y, dual, v, z, g, move, values
        for k, array in enumerate(self.arrays, 1):
            if array is not None:
                self.kernel.set_arg(k, array.data)
        options = prox._parameters
        self.kernel.set_arg(13, np.int32(options["positive"]))
        self.kernel.set_arg(14, np.int32(options["n_iterations"]))
        self.kernel.set_arg(15, real(options["tolerance"]))

    def __call__(self, morphs, active, step, factor, first):
        self.kernel.set_arg(0, morphs.data)
        self.kernel.set_arg(3, active.data)
        self.device.launch(self.kernel, (active.size * self.group,), (self.group,))


def _stands_alone(prox):
    return isinstance(prox, MonotoneProjection)


def _table(prox, n_sources):
    """The step's two parameters per source (2, S)."""
    table = np.zeros((2, n_sources))
    for row, named in zip(table, prox._values(), strict=True):
        for name, value in named.items():
            if np.shape(value) not in ((), (n_sources,)):
                raise ValueError(f"{name} has shape {np.shape(value)} for {n_sources} sources")
            row[:] = value
    return table


def _at_least_0(name, value, most=np.inf):
    value = np.asarray(value)
    if not ((value >= 0) & (value <= most)).all():
        raise ValueError(f"{name} is {value}, it must lie between 0 and {most}")
    return value
