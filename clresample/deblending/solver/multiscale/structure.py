"""Morphologies of structure at several scales, and their transpose, on the device.

The kernels are those of structure.cl.

    S_s = max(0, b + u - b <b, u> / <b, b>),      u_s = sqrt(b) o sum_j K_j z_sj

The coefficients z_sj of scale j lie on every steps[j]-th pixel of the source's box; K_j on such a
grid is steps[j] times its taps, so that u has the variance, and z the meaning, of the full grid's.
"""

from __future__ import annotations

import numpy as np

from ....device.rounding import round_up
from ..boxes import ALIGN


def coarse_count(n_pixels, step):
    """Coefficients along a side of `n_pixels`: one every `step`, to its last pixel or past it."""
    return (np.asarray(n_pixels) + step - 2) // step + 1


def no_structure(shape, steps):
    """Coefficients (J) of 0 in a box of a shape (2,), as arrays (ny_j, nx_j)."""
    return [np.zeros(coarse_count(shape, step)) for step in steps]


class LatentLayout:
    """Layout of the coefficients of all free sources of a batch in one vector.

    boxes: Boxes; free (n_free,): sources that have coefficients; steps (J,)
    shape (S, J, 2): coefficients of each source and scale along y, x; 0 of sources that are fixed
    start (S,): first element of each source, a multiple of ALIGN; size: elements in all
    """

    def __init__(self, boxes, free, steps):
        self.boxes, self.steps = boxes, tuple(steps)
        self.shape = np.stack([coarse_count(boxes.shape, step) for step in steps], axis=1)
        self.shape[np.setdiff1d(np.arange(len(boxes)), free)] = 0
        used = self.shape.prod(2).sum(1)
        ends = np.cumsum(round_up(used, ALIGN))
        self.start = np.concatenate([[0], ends])[:-1]
        self.size = int(ends[-1])

    def planes(self):
        """First element and length (S, J, 2) of each source's scales."""
        length = self.shape.prod(2)
        first = self.start[:, None] + np.cumsum(length, axis=1) - length
        return np.stack([first, length], axis=2)

    def pack(self, arrays):
        """One vector (size,) from arrays[s][j] of the shapes `shape`.

        It contains free sources alone, and 0 for those whose arrays[s] is None.
        """
        out = np.zeros(self.size)
        for s, scales in enumerate(arrays):
            if scales is not None and self.shape[s].any():
                flat = np.concatenate([np.ravel(a) for a in scales])
                out[self.start[s] : self.start[s] + len(flat)] = flat
        return out

    def unpack(self, vector, sources=slice(None)):
        """Arrays [s][j] (ny_j, nx_j), float64, of some sources in a vector (size or more,)."""
        places = zip(self.planes()[sources], self.shape[sources], strict=True)
        return [
            [
                vector[a : a + n].reshape(shape).astype(np.float64)
                for (a, n), shape in zip(planes, shapes, strict=True)
            ]
            for planes, shapes in places
        ]


class StructureOperator:
    """The morphologies of a batch's free sources from their coefficients, and the way back.

    buffers: the batch; its morph is overwritten by `form`, its d_morph by `gradient`
    prior: the MultiscalePrior; latents: the LatentLayout
    energies (S, J): of the coefficients passed last, on the device
    """

    def __init__(self, buffers, prior):
        b = self.buffers = buffers
        free = b.device.get(b.free)[: b.n_free]
        self.latents = LatentLayout(b.host_boxes, free, prior.steps)
        self.n_scales = len(prior.steps)
        margin = round_up(max(prior.radii) + max(prior.steps), ALIGN)
        n_taps = 2 * max(prior.radii) + 2
        taps = np.zeros((self.n_scales, n_taps))
        for row, kernel, step in zip(taps, prior.kernels(), prior.steps, strict=True):
            row[: len(kernel)] = kernel * np.sqrt(step)
        macros = {
            "N_SCALES": self.n_scales,
            "RADII": _list(prior.radii),
            "STEPS": _list(prior.steps),
            "TAPS": n_taps,
            "MARGIN": margin,
            "WG": b.tuning.vector_group,
        }
        rows = self.latents.shape[:, :, 0].sum(1)
        lines = np.maximum(rows, b.host_boxes.shape[:, 0])  # of condense, and of spread
        width = round_up(b.host_boxes.shape[:, 1], ALIGN) + 2 * margin + ALIGN
        scratch = np.concatenate([[0], np.cumsum(lines * width)])
        line = b.device.zeros(max(int(scratch[-1]), 1) if b.tuning.row_loops else 1, b.dtype)
        start = np.stack([self.latents.start, scratch[:-1]], axis=1) // ALIGN
        power = np.array([(p * p).sum() for s in b.scenes for p in s.profile])
        inverse = np.divide(1, power, where=power > 0, out=np.zeros_like(power))
        shared = {"active": b.free, "table": b.boxes.table}
        placed = shared | {"start": b.device.put(start, np.int32)}
        sided = placed | {"taps": b.put(taps), "line": line}
        gauged = shared | {"inverse": b.put(inverse), "profile": b.profile, "morph": b.morph}
        group = b.tuning.vector_group
        launcher = b.launcher
        u = b.zeros_flat()
        self.energies = b.put(np.zeros((b.n_sources, self.n_scales)))
        self._spread = launcher("structure.cl", "coefficients_to_image", 3, **macros).bind(
            **sided, amp=b.amplitude, u=u
        )
        self._form = launcher(
            "structure.cl", "form_morphology", 2, local_size=(group, 1), **macros
        ).bind(**gauged, u=u)
        self._unform = launcher(
            "structure.cl", "morphology_adjoint", 2, local_size=(group, 1), **macros
        ).bind(**gauged, amp=b.amplitude, d_morph=b.d_morph)
        self._condense = launcher("structure.cl", "image_to_coefficients", 3, **macros).bind(
            **sided, q=b.d_morph
        )
        self._energy = launcher(
            "structure.cl", "coefficient_norms", 3, local_size=(group, 1, 1), **macros
        ).bind(**placed, out=self.energies)
        self._rows_size = b.strided_rows(b.host_boxes.shape, b.n_free)
        coarse = np.column_stack([rows, b.host_boxes.shape[:, 1]])
        self._coarse_size = b.strided_rows(coarse, b.n_free)
        self._sources_size = group, b.n_free
        self._energy_size = group, self.n_scales, b.n_free

    def form(self, vector):
        """Queues the morphologies of a vector (latents.size or more,) of coefficients."""
        if self.buffers.n_free:
            self._spread(self._rows_size, z=vector)
            self._form(self._sources_size)

    def gradient(self, vector, precision, gradient):
        """Queues dL/dz + precision z into a vector, from d_morph, which is overwritten.

        vector: the coefficients that the morphologies were formed of; precision (S, J)
        """
        if self.buffers.n_free:
            self._unform(self._sources_size)
            self._condense(self._coarse_size, z=vector, precision=precision, gradient=gradient)

    def energy(self, vector):
        """Queues sum z_sj^2 of a vector into `energies`."""
        if self.buffers.n_free:
            self._energy(self._energy_size, z=vector)


def _list(values):
    """An initialiser in C."""
    return "{" + ", ".join(map(str, values)) + "}"
