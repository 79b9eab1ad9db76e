"""Launches of the constraints' kernel, prox.cl."""

from __future__ import annotations

import numpy as np

from ...deblending.solver.boxes import ALIGN
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


def parameter_table(prox, n_sources):
    """The step's two parameters per source (2, S)."""
    table = np.zeros((2, n_sources))
    for row, named in zip(table, prox.values(), strict=True):
        for name, value in named.items():
            if np.shape(value) not in ((), (n_sources,)):
                raise ValueError(f"{name} has shape {np.shape(value)} for {n_sources} sources")
            row[:] = value
    return table
