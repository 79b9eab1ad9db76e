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
        source = b.host_first
        starts = np.append(self.latents.start, self.latents.size)
        sky = self.latents.size + self.n_spectra
        ends = starts[source], self.latents.size + source * c, sky + np.arange(len(source)) * c
        return np.stack([np.stack([e[:-1], e[1:]], axis=1) for e in ends], axis=1)

    def split(self, vector, which):
        """Of a vector the parts of the scenes `which` (B,), None for the others.

        Coefficients [s][j] (ny_j, nx_j), spectra (n, C) and sky (C,), float64
        """
        parts, source, found = self.parts(), self.buffers.host_first, [None] * len(which)
        values = self.buffers.device.get_parts(vector, parts[which].swapaxes(0, 1))
        for i in np.flatnonzero(which):
            spectra, sky = (values[a:b].astype(np.float64) for a, b in parts[i, 1:])
            structure = self.latents.unpack(values, slice(*source[i : i + 2]))
            found[i] = structure, spectra.reshape(-1, self.buffers.n_channels), sky
        return found

    def put_directions(self, steps):
        """Overwrites the directions d of some scenes.

        steps {scene: parts as of `split`}, structure None where a source has none.
        """
        pieces, source = {}, self.buffers.host_first
        for i, parts in zip(steps, self.parts()[list(steps)], strict=True):
            structure, by_spectrum, by_sky = steps[i]
            (low, high), (at_spectra, _), (at_sky, _) = parts.tolist()
            values = np.zeros(high - low)
            for start, scales in zip(self.latents.start[source[i] :], structure):
                if scales is not None:
                    flat = np.concatenate([np.ravel(part) for part in scales])
                    values[start - low : start - low + len(flat)] = flat
            pieces |= {low: values, at_spectra: np.ravel(by_spectrum), at_sky: np.ravel(by_sky)}
        self.buffers.device.put_parts(pieces, self.d)

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
