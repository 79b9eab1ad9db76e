"""Launches of the constraints' kernels, prox.cl and project.cl."""

from __future__ import annotations

import numpy as np

from .boxes import ALIGN

# Work-items a source: on a CPU one, with no barriers; on a GPU as many as every GPU allows.
GROUP = {"CPU": 1}
GROUP_ELSEWHERE = 64
# STEP0 .. STEP7 of prox.cl.
MOST_STEPS = 8


class FusedSteps:
    """Up to 8 steps on some boxes: the two kernels of prox.cl with all that stays set."""

    def __init__(self, steps, boxes, dtype):
        self.device, n = boxes.device, len(boxes)
        self.group = GROUP.get(self.device.kind, GROUP_ELSEWHERE)
        values = np.array([parameter_table(step, n) for step in steps])
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


class ProjectionLaunch:
    """project.cl on some boxes, with its dual and its scratch."""

    def __init__(self, prox, boxes, dtype):
        device, n = boxes.device, len(boxes)
        self.device, self.group = device, GROUP.get(device.kind, GROUP_ELSEWHERE)
        planes = -(-(boxes.boxes.shape.astype(np.int64) + 2).prod(1) // ALIGN)
        pads = device.put(np.concatenate([[0], np.cumsum(planes)])[:-1], np.int32)
        size = int(planes.sum()) * ALIGN
        values = device.put(parameter_table(prox, n), dtype)
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


def parameter_table(prox, n_sources):
    """The step's two parameters per source (2, S)."""
    table = np.zeros((2, n_sources))
    for row, named in zip(table, prox._values(), strict=True):
        for name, value in named.items():
            if np.shape(value) not in ((), (n_sources,)):
                raise ValueError(f"{name} has shape {np.shape(value)} for {n_sources} sources")
            row[:] = value
    return table
