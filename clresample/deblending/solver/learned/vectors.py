"""The variables of a batch of scenes as vectors on the device, and the kernels of lbfgs.cl on them.

    x = (z of all free sources, A (S, C), sky (B, C))
"""

from __future__ import annotations

import numpy as np

# What `Vectors.advance` does with a scene; the same numbers in lbfgs.cl.
REST, NEXT, AGAIN, TRY, STAY = range(5)
# Elements of a vector that one sum runs over: on CPUs what stays in the first cache with all that
# it is multiplied by, elsewhere some for each work-item of a group.
CHUNK, CHUNK_ELSEWHERE = 512, 4096


class Vectors:
    """Vectors of a batch, and where each scene's part of them lies.

    buffers: the batch; latents: its Latents; n_slots: of the ring
    size: elements of a vector; chunks (n, 4): scene, first element, length, bounded
    x, x_new, g, g_new, d, h (size,): see lbfgs.cl; s, y (n_slots, size)
    """

    def __init__(self, buffers, latents, n_slots):
        b = self.buffers = buffers
        self.latents, self.n_slots = latents, n_slots
        self.n_spectra, self.n_sky = b.spectra.size, b.sky.size
        self.size = latents.size + self.n_spectra + self.n_sky
        if self.size > np.iinfo(np.int32).max:
            raise ValueError(f"a batch of {self.size} variables is too large: use less memory")
        self.x, self.x_new, self.g, self.g_new, self.d, self.h = (
            b.device.zeros(self.size, b.dtype) for _ in range(6)
        )
        self.s, self.y = (b.device.zeros((n_slots, self.size), b.dtype) for _ in range(2))
        self.chunks = self._chunks()
        self._scene_starts = np.flatnonzero(np.diff(self.chunks[:, 0], prepend=-1))
        self._bind()

    def _chunks(self):
        """The parts of a vector, sorted by scene."""
        b, rows = self.buffers, []
        length = CHUNK if b.tuning.row_loops else CHUNK_ELSEWHERE
        first = b.device.get(b.first)
        starts = np.append(self.latents.start, self.latents.size)
        n_channels = b.n_channels
        for i in range(len(b.scenes)):
            source, end = first[i], first[i + 1]
            spectra, sky = self.latents.size, self.latents.size + self.n_spectra
            for low, high, bounded in (
                (starts[source], starts[end], 0),
                (spectra + source * n_channels, spectra + end * n_channels, 1),
                (sky + i * n_channels, sky + (i + 1) * n_channels, 0),
            ):
                rows += [
                    (i, at, min(length, high - at), bounded) for at in range(low, high, length)
                ]
        return np.array(rows)

    def _bind(self):
        b, n = self.buffers, self.n_slots
        group = b.tuning.sum_group
        self._live_slots = b.device.put(np.ones(len(b.scenes)), np.int32)
        self._spare = b.device.put(np.zeros(len(b.scenes)), np.int32)
        self._mode = b.device.put(np.zeros(len(b.scenes)), np.int32)
        self._coefficients = b.put(np.zeros((len(b.scenes), 2 * n + 2)))
        self._sums = b.put(np.zeros((len(self.chunks), 4 * n + 1)))
        self._gram_sums = None
        scratch = [b.device.zeros(self.size, b.dtype) for _ in range(3)]
        shared = {
            "chunks": b.device.put(self.chunks, np.int32),
            "mode": self._mode,
            "slots": self._live_slots,
            "size": self.size,
            "h": self.h,
            "ring_s": self.s,
            "ring_y": self.y,
        }
        macros = {"WG": group, "SLOTS": n}

        def launcher(name, size=(group, 1)):
            return b.launcher("lbfgs.cl", name, len(size), local_size=size, **macros)

        self._change = launcher("change").bind(
            **shared,
            spare=self._spare,
            x=self.x,
            x_new=self.x_new,
            g=self.g,
            g_new=self.g_new,
            projected=scratch[0],
            weighed_g=scratch[1],
            weighed_y=scratch[2],
            out=self._sums,
        )
        self._gram = launcher("gram").bind(**shared, weighed_y=scratch[2])
        self._advance = launcher("advance").bind(
            **shared,
            coefficients=self._coefficients,
            g_new=self.g_new,
            x=self.x,
            g=self.g,
            d=self.d,
            x_new=self.x_new,
        )
        planes = self.latents.planes()
        self._reweigh = launcher("reweigh", (group, 1, 1)).bind(
            active=b.free,
            table=b.boxes.table,
            planes=b.device.put(planes.reshape(-1, 2), np.int32),
            slots=self._live_slots,
            size=self.size,
            x_new=self.x_new,
            ring_s=self.s,
            g_new=self.g_new,
            ring_y=self.y,
            h=self.h,
        )
        self._size = group, len(self.chunks)
        self._reweigh_size = group, planes.shape[1], b.n_free
        names = {"n_latents": self.latents.size, "n_spectra": self.n_spectra}
        self._take = b.launcher("lbfgs.cl", "take", 1, **macros).bind(
            **names, spectra=b.spectra, sky=b.sky
        )
        self._give = b.launcher("lbfgs.cl", "give", 1, **macros).bind(
            **names, n_channels=b.n_channels, d_spectra=b.d_spectra, g_new=self.g_new
        )

    def follow(self, pairs):
        """Take over which slots of the ring the Pairs use by now."""
        b = self.buffers
        b.device.upload(pairs.used.astype(np.int32), self._live_slots)
        b.device.upload(np.ascontiguousarray(pairs.spare, np.int32), self._spare)

    def start(self, spectra, sky, inverse_curvature):
        """Put the first trial there: z = 0, spectra (S, C), sky (B, C); and h of both of these."""
        for vector, parts in ((self.x_new, (spectra, sky)), (self.h, inverse_curvature)):
            flat = np.concatenate([np.zeros(self.latents.size), *(np.ravel(p) for p in parts)])
            self.buffers.device.upload(flat.astype(self.buffers.dtype), vector)
            if vector is self.x_new:
                self.buffers.device.copy(vector, self.x)

    def take(self, vector=None):
        """Queue spectra and sky levels of the trial, or of another vector, into the buffers."""
        self._take(
            (self.n_spectra + self.n_sky,), x_new=self.x_new if vector is None else vector
        )

    def give(self, pull, rows):
        """Queue the gradients of spectra and sky into g_new; pull (B, n), rows (C + 1,)."""
        self._give(
            (self.n_spectra + self.n_sky,), pull=pull, n_rows=pull.shape[1], row0=rows
        )

    def change(self):
        """Queue what the trial changes into the spare slots, and its inner products."""
        self._change(self._size)

    def sums(self):
        """Of `change`, per scene: s_k . P g, y_k . h P g, s_k . y, y_k . h y (B, slots, 4), and
        g . s (B,); of scenes at rest whatever was there."""
        sums = self._per_scene(self._sums)
        return sums[:, :-1].reshape(len(sums), self.n_slots, 4), sums[:, -1]

    def gram(self):
        """s_k . y_l and y_k . h y_l (B, slots, slots) of all slots."""
        n = self.n_slots
        if self._gram_sums is None:
            self._gram_sums = self.buffers.put(np.zeros((len(self.chunks), 2 * n * n)))
        self._gram(self._size, out=self._gram_sums)
        sums = self._per_scene(self._gram_sums).reshape(-1, n, n, 2)
        return sums[..., 0], sums[..., 1]

    def _per_scene(self, sums):
        values = self.buffers.device.get(sums).astype(np.float64)
        return np.add.reduceat(values, self._scene_starts, axis=0)

    def advance(self, mode, a, c, scale, length):
        """Queue the next trials: mode (B,) of REST, NEXT, ...; a, c (B, slots), scale, length (B,)."""
        b = self.buffers
        self.set_mode(mode)
        table = np.concatenate([a, c, scale[:, None], length[:, None]], axis=1)
        b.device.upload(np.ascontiguousarray(table, b.dtype), self._coefficients)
        self._advance(self._size)

    def set_mode(self, mode):
        """What the next kernels do with each scene: REST leaves it as it is."""
        self.buffers.device.upload(np.ascontiguousarray(mode, np.int32), self._mode)

    def reweigh(self, light, weights):
        """Queue h, g_new and y of other strengths; weights (S, J, 3), see lbfgs.cl."""
        if self.buffers.n_free:
            self._reweigh(self._reweigh_size, light=light, weights=self.buffers.put(weights))
