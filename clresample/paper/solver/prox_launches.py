"""Launches of the constraints' kernels, prox.cl and project.cl."""

from __future__ import annotations

import numpy as np

from ...deblending.solver.boxes import ALIGN
from ...device.discovery import DeviceError
from ...device.tuning import Tuning

# STEP0 .. STEP7 of prox.cl.
MAX_STEPS = 8


class FusedSteps:
    """Up to 8 steps on some boxes: the two kernels of prox.cl with all that stays bound."""

    def __init__(self, steps, boxes, dtype):
        device, n = boxes.device, len(boxes)
        self.group = Tuning.of(device, dtype).sum_group
        values = device.put(np.array([parameter_table(step, n) for step in steps]), dtype)
        macros = {"WG": self.group, "ALIGN": ALIGN, "dtype": dtype, "local_size": (self.group,)}
        macros |= {f"STEP{k}": step.name for k, step in enumerate(steps)}
        self.chain, self.chain_factor = (
            device.launcher("prox.cl", kernel, **macros).bind(
                table=boxes.table, values=values, n_sources=n
            )
            for kernel in ("chain", "chain_factor")
        )

    def __call__(self, morphs, active, step, factor, first):
        """Queues the steps; arguments as of `Prox.prox`, first: whether `factor` starts from 1."""
        size = (active.size * self.group,)
        if factor is None:
            self.chain(size, x=morphs, active=active, step=step)
        else:
            given = {"factor": factor, "first": first}
            self.chain_factor(size, x=morphs, active=active, step=step, **given)


class ProjectionLaunch:
    """project.cl on some boxes, with its dual and its scratch."""

    def __init__(self, prox, boxes, dtype):
        device, n = boxes.device, len(boxes)
        tuning = Tuning.of(device, dtype)
        self.group, self.n_iterations = tuning.sum_group, prox.parameters["n_iterations"]
        planes = -(-(boxes.boxes.shape.astype(np.int64) + 2).prod(1) // ALIGN)
        size = int(planes.sum()) * ALIGN
        given = {
            "table": boxes.table,
            "pads": device.put(np.concatenate([[0], np.cumsum(planes)])[:-1], np.int32),
            "values": device.put(parameter_table(prox, n), dtype),
            "w": device.zeros(8 * size, dtype),
        }
        given |= {name: device.zeros(size, dtype) for name in ("tau", "z")}
        macros = {"WG": self.group, "ALIGN": ALIGN, "dtype": dtype, "local_size": (self.group,)}
        weigh = device.launcher("project.cl", "project_weights", **macros).bind(**given)
        weigh((n * self.group,), active=boxes.everyone, n_sources=n)
        given |= {name: device.zeros(size, dtype) for name in ("y", "l", "v", "g", "move")}
        self.project = device.launcher("project.cl", "project", **macros).bind(
            **given,
            momenta=device.zeros(n, dtype),
            **{name: prox.parameters[name] for name in ("positive", "tolerance")},
        )
        self.most = self.n_iterations
        if tuning.max_loop_iterations is not None:
            self.most = most_iterations(
                device, int(planes.max()) * ALIGN, self.group, tuning.max_loop_iterations
            )

    def __call__(self, morphs, active, step, factor, first):
        """Queues the projection, which ignores the last three arguments."""
        size, end = (active.size * self.group,), self.n_iterations
        for begin in range(0, max(end, 1), max(self.most, 1)):
            span = {"first": begin, "last": min(begin + self.most, end)}
            self.project(size, x=morphs, active=active, **span)


def most_iterations(device, n, group, loops):
    """Iterations of the projection in one launch on a device that limits loops to `loops`.

    n: elements of the largest plane, group: work-items that share it.

    DeviceError: not even one is possible
    """
    walk = -(-n // group) + 1  # one pass over the plane, and the look that ends it
    # Image and dual, and each fourth time two sums: of four elements a step, then over the group.
    # Before and after all turns one such sum and four passes.
    inner = walk / 4 + 1 + group
    turn, once = 1 + 2 * walk + 2 * inner / 4, 4 * walk + inner
    most = int((loops - once) / turn)
    if most < 1:
        raise DeviceError(
            f"{device.name} ends the loops of a kernel after {loops} iterations, too few for a "
            f"projection of {n} pixels: use smaller boxes, or another device"
        )
    return most


def parameter_table(prox, n_sources):
    """The step's two parameters per source (2, S)."""
    table = np.zeros((2, n_sources))
    for row, named in zip(table, prox.values(), strict=True):
        for name, value in named.items():
            if np.shape(value) not in ((), (n_sources,)):
                raise ValueError(f"{name} has shape {np.shape(value)} for {n_sources} sources")
            row[:] = value
    return table
