"""The variables of a batch of scenes as vectors on the device, and their layout.

x = (z of all free sources, A (S, C), sky (B, C))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class SceneGradient:
    """Gradient of one scene's loss by its variables.

    structure [s][j] (ny_j, nx_j): by the coefficients of each source and scale
    spectra (n, C), sky (C,); at_bound (n, C): spectra that are 0 and would fall
    """

    structure: list
    spectra: np.ndarray
    sky: np.ndarray
    at_bound: np.ndarray


class SolverVectors:
    """The vectors of a batch that L-BFGS works on.

    buffers: the batch; latents: its LatentLayout; n_slots: of the ring of pairs
    size: elements of a vector; n_spectra, n_sky: its last ones
    chunks (n, 4): scene, first element, length, whether its variables are at least 0; by scene
    x, x_new, g, g_new, hg, d, h, precision (size,): see lbfgs.cl; s, hy (n_slots, size)
    """

    NAMES = "x", "x_new", "g", "g_new", "hg", "d", "h", "precision", "s", "hy"

    def __init__(self, buffers, latents, n_slots):
        b = self.buffers = buffers
        self.latents, self.n_slots = latents, n_slots
        self.n_spectra, self.n_sky = b.spectra.size, b.sky.size
        self.size = latents.size + self.n_spectra + self.n_sky
        if self.size > np.iinfo(np.int32).max:
            raise ValueError(f"a batch of {self.size} variables is too large: use less memory")
        self.x, self.x_new, self.g, self.g_new, self.hg, self.d, self.h, self.precision = (
            b.device.zeros(self.size, b.dtype) for _ in range(8)
        )
        self.s, self.hy = (b.device.zeros((n_slots, self.size), b.dtype) for _ in range(2))
        self.chunks = self._chunks()
        self.chunk_table = b.device.put(self.chunks, np.int32)
        names = {"n_latents": latents.size, "n_spectra": self.n_spectra}
        names["n"] = self.n_spectra + self.n_sky
        self._numbers_size = b.items(names["n"])
        self._take = b.launcher("vectors.cl", "unpack_spectra", 1).bind(
            **names, spectra=b.spectra, sky=b.sky
        )
        self._give = b.launcher("vectors.cl", "pack_gradients", 1).bind(
            **names, n_channels=b.n_channels, d_spectra=b.d_spectra, g_new=self.g_new
        )

    def parts(self):
        """First and one-past-last elements (B, 3, 2) of each scene's z, spectra and sky."""
        b, c = self.buffers, self.buffers.n_channels
        source = b.device.get(b.first).astype(np.int64)
        starts = np.append(self.latents.start, self.latents.size)
        sky = self.latents.size + self.n_spectra
        ends = starts[source], self.latents.size + source * c, sky + np.arange(len(source)) * c
        return np.stack([np.stack([e[:-1], e[1:]], axis=1) for e in ends], axis=1)

    def split(self, vector):
        """Splits a host vector by scenes: coefficients [s][j], spectra (n, C) and sky (C,).

        Coefficients have the shape (ny_j, nx_j).
        """
        values = self.buffers.device.get(vector).astype(np.float64)
        structure = self.latents.unpack(values)
        spectra, sky = self._numbers(values)
        source = self.buffers.device.get(self.buffers.first)
        return [
            (structure[a:b], spectra[a:b], sky[i])
            for i, (a, b) in enumerate(zip(source[:-1], source[1:], strict=True))
        ]

    def put_directions(self, steps):
        """Overwrites the directions d of some scenes.

        steps {scene: parts as of `split`}, structure None where a source has none.
        """
        values = self.buffers.device.get(self.d)
        spectra, sky = self._numbers(values)
        source = self.buffers.device.get(self.buffers.first)
        for low, high in self.parts()[list(steps), 0]:
            values[low:high] = 0
        for i, (structure, by_spectrum, by_sky) in steps.items():
            spectra[source[i] : source[i + 1]], sky[i] = by_spectrum, by_sky
            for start, scales in zip(self.latents.start[source[i] :], structure):
                if scales is not None:
                    flat = np.concatenate([np.ravel(part) for part in scales])
                    values[start : start + len(flat)] = flat
        self.buffers.device.upload(values, self.d)

    def _numbers(self, values):
        """Spectra (S, C) and sky levels (B, C) in the elements of a vector, on the host."""
        n, c = self.latents.size, self.buffers.n_channels
        both = values[n:].reshape(-1, c)
        return both[: self.n_spectra // c], both[self.n_spectra // c :]

    def _chunks(self):
        length, rows = self.buffers.tuning.vector_chunk, []
        for i, parts in enumerate(self.parts()):
            for k, (low, high) in enumerate(parts):
                starts = np.arange(low, high, length)
                rows += [(i, at, min(length, high - at), k == 1) for at in starts]
        return np.array(rows)

    def start(self, structure, spectra, sky, inverse_curvature):
        """Uploads x and the first trial: z (latents.size,), spectra (S, C), sky (B, C).

        Also uploads h of the spectra and the sky.
        """
        upload, nothing = self.buffers.device.upload, np.zeros(self.latents.size)
        there, h = (
            np.concatenate([first, *map(np.ravel, parts)]).astype(self.buffers.dtype)
            for first, parts in ((structure, (spectra, sky)), (nothing, inverse_curvature))
        )
        upload(there, self.x)
        upload(there, self.x_new)
        upload(h, self.h)

    def copy_from(self, other, keep):
        """Copies the scenes `keep` (n,) of other SolverVectors, which then are all scenes here."""
        shift = (other.parts()[keep] - self.parts())[:, :, 0]
        scene, first = self.chunks[:, 0], self.chunks[:, 1]
        kind = np.digitize(first, [self.latents.size, self.latents.size + self.n_spectra])
        source = self.buffers.device.put(first + shift[scene, kind], np.int32)
        group = self.buffers.tuning.sum_group
        move = self.buffers.launcher("vectors.cl", "copy_chunks", 3, local_size=(group, 1, 1))
        move.bind(chunks=self.chunk_table, source=source, size=self.size, size_from=other.size)
        for name in self.NAMES:
            n_rows = self.n_slots if name in ("s", "hy") else 1
            size = group, len(self.chunks), n_rows
            move(size, values_from=getattr(other, name), values=getattr(self, name))

    def unpack_spectra(self, vector):
        """Queues spectra and sky levels of a vector into the batch's buffers."""
        self._take(self._numbers_size, x=vector)

    def pack_gradients(self, pull, rows):
        """Queues the gradients of spectra and sky into g_new; pull (B, n), rows (C + 1,)."""
        n_rows = pull.shape[1]
        self._give(self._numbers_size, pull=pull, n_rows=n_rows, row0=rows)
