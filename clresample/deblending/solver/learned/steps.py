"""Directions, steps and inner products of the Vectors of a batch: the kernels of lbfgs.cl."""

from __future__ import annotations

import numpy as np

# What the kernels do with a scene; the same numbers in lbfgs.cl.
REST, NEXT, AGAIN, TRY, STAY = range(5)


class Steps:
    """L-BFGS on the Vectors of a batch; the decisions come as arrays over its scenes (B,).

    vectors: the Vectors
    """

    def __init__(self, vectors):
        v, n_slots = vectors, vectors.n_slots
        b = self._buffers = v.buffers
        self._n_slots, self._n_chunks = n_slots, len(v.chunks)
        self._first_chunks = np.flatnonzero(np.diff(v.chunks[:, 0], prepend=-1))
        n = len(b.scenes)
        self._plan = b.device.put(np.zeros((n, 3)), np.int32)
        self._coefficients = b.put(np.zeros((n, 2 * n_slots + 2)))
        self._sums = b.put(np.zeros((self._n_chunks, 4 * n_slots + 2)))
        self._gram_sums = None  # large, and of use only where strengths are learned
        scratch = [b.device.zeros(v.size, b.dtype) for _ in range(3)]
        ring = {"plan": self._plan, "size": v.size, "h": v.h, "ring_s": v.s, "ring_y": v.y}
        shared = ring | {"chunks": v.chunk_table}
        trial = {"x": v.x, "x_new": v.x_new, "g": v.g, "g_new": v.g_new}
        group = b.tuning.sum_group

        def launcher(name, size=(group, 1)):
            return b.launcher("lbfgs.cl", name, len(size), local_size=size, SLOTS=n_slots)

        self._change = launcher("change").bind(
            **shared,
            **trial,
            precision=v.precision,
            projected=scratch[0],
            weighed_g=scratch[1],
            weighed_y=scratch[2],
            out=self._sums,
        )
        self._gram = launcher("gram").bind(**shared, weighed_y=scratch[2])
        self._advance = launcher("advance").bind(
            **shared, **trial, coefficients=self._coefficients, d=v.d
        )
        planes = v.latents.planes()
        self._reweigh = launcher("reweigh", (group, 1, 1)).bind(
            **ring,
            active=b.free,
            table=b.boxes.table,
            planes=b.device.put(planes.reshape(-1, 2), np.int32),
            x_new=v.x_new,
            g_new=v.g_new,
            precision=v.precision,
        )
        self._size = group, self._n_chunks
        self._reweigh_size = group, planes.shape[1], b.n_free

    def follow(self, pairs, mode):
        """What all that is queued next does with each scene, mode (B,) of REST, NEXT, ..., and
        which slots of the ring the Pairs use by now."""
        plan = np.stack([mode, pairs.used, pairs.spare], axis=1)
        self._buffers.device.upload(np.ascontiguousarray(plan, np.int32), self._plan)

    def change(self):
        """What trials change: s and y into the spare slots, and s_k . P g, y_k . h P g, s_k . y,
        y_k . h y (B, slots, 4), g . s (B,), x_new . precision x_new (B,); of scenes at rest, what
        there was."""
        self._change(self._size)
        sums = self._by_scene(self._sums)
        return sums[:, :-2].reshape(len(sums), self._n_slots, 4), sums[:, -2], sums[:, -1]

    def gram(self):
        """s_k . y_l and y_k . h y_l (B, slots, slots) of all slots."""
        n = self._n_slots
        if self._gram_sums is None:
            self._gram_sums = self._buffers.put(np.zeros((self._n_chunks, 2 * n * n)))
        self._gram(self._size, out=self._gram_sums)
        sums = self._by_scene(self._gram_sums).reshape(-1, n, n, 2)
        return sums[..., 0], sums[..., 1]

    def _by_scene(self, sums):
        values = self._buffers.device.get(sums).astype(np.float64)
        return np.add.reduceat(values, self._first_chunks, axis=0)

    def advance(self, a, c, scale, length):
        """Queue the next trials: a, c (B, slots), scale, length (B,)."""
        b = self._buffers
        table = np.concatenate([a, c, scale[:, None], length[:, None]], axis=1)
        b.device.upload(np.ascontiguousarray(table, b.dtype), self._coefficients)
        self._advance(self._size)

    def reweigh(self, light, weights):
        """Queue h, g_new and y of other strengths; weights (S, J, 3), see lbfgs.cl."""
        if self._buffers.n_free:
            self._reweigh(self._reweigh_size, light=light, weights=self._buffers.put(weights))
