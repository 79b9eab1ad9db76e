"""Directions, steps and inner products of a batch's vectors: lbfgs.cl and block_inverse.cl."""

from __future__ import annotations

import numpy as np

from ....device.rounding import round_up
from ..boxes import ALIGN
from .factor_store import FactorStore
from .inverse import MAX_BLOCK_SIZE, PANEL

# What the kernels do with a scene; the same numbers in lbfgs.cl.
REST, NEXT, AGAIN, TRY, STAY = range(5)
# Largest number of variables of a run of directions, so that several cores share those of a source;
# and work-items of a run on GPUs.
MAX_RUN, RUN_LANES = 2048, 32


class LbfgsSteps:
    """L-BFGS on the SolverVectors of a batch; decisions are arrays over its scenes (B,).

    vectors: the SolverVectors
    shelf: FactorStore of the blocks, which may be that of other LbfgsSteps; None = a new one
    """

    def __init__(self, vectors, shelf=None):
        v, n_slots = vectors, vectors.n_slots
        b, self._latents = v.buffers, v.latents
        self._buffers = b
        self._n_slots, self._n_chunks, self._sizes = n_slots, len(v.chunks), v.parts()
        self._first_chunks = np.flatnonzero(np.diff(v.chunks[:, 0], prepend=-1))
        n = len(b.scenes)
        self._plan = b.device.put(np.zeros((n, 3)), np.int32)
        self._coefficients = b.put(np.zeros((n, 2 * n_slots + 2)))
        self._sums = b.put(np.zeros((self._n_chunks, 4 * n_slots + 2)))
        self._levels, self._directions, self._directions_of = [], None, None
        self.shelf = shelf or FactorStore(b.device, b.dtype)
        self._sent = []  # events of uploads that may be on their way
        y, projected, hg_new = (b.device.zeros(v.size, b.dtype) for _ in range(3))
        shared = {"plan": self._plan, "size": v.size, "ring_s": v.s, "ring_hy": v.hy}
        shared |= {"chunks": v.chunk_table, "x_new": v.x_new}
        group = b.tuning.vector_group

        def launcher(name, size=(group, 1)):
            macros = {"SLOTS": n_slots, "WG": group}
            return b.launcher("lbfgs.cl", name, len(size), local_size=size, **macros)

        self._trial = launcher("form_pairs").bind(
            **shared,
            x=v.x,
            g=v.g,
            g_new=v.g_new,
            h=v.h,
            y=y,
            projected=projected,
            hg_new=hg_new,
        )
        self._lanes = 1 if b.tuning.row_loops else RUN_LANES
        macros = {"MAX_BLOCK": MAX_BLOCK_SIZE, "PANEL": PANEL, "LANES": self._lanes, "WG": group}
        products = {"plan": self._plan, "y": y, "projected": projected}
        added = {"plan": self._plan, "size": v.size, "ring_hy": v.hy, "hg_new": hg_new}
        self._invert, self._multiply_directions, self._add_directions = (
            b.launcher("block_inverse.cl", name, 1, local_size=size, **macros).bind(**given)
            for name, size, given in (
                ("apply_block_inverse", (group,), products | added),
                ("direction_products", (group,), products),
                ("add_directions", None, added),
            )
        )
        self._change = launcher("inner_products").bind(
            **shared, g=v.g, y=y, projected=projected, precision=v.precision, out=self._sums
        )
        self._advance = launcher("take_step").bind(
            **shared,
            x=v.x,
            g=v.g,
            g_new=v.g_new,
            hg=v.hg,
            hg_new=hg_new,
            d=v.d,
            coefficients=self._coefficients,
        )
        planes = v.latents.planes()
        self._reweigh = launcher("update_preconditioner", (group, 1, 1)).bind(
            active=b.free,
            planes=b.device.put(planes.reshape(-1, 2), np.int32),
            x_new=v.x_new,
            g_new=v.g_new,
            precision=v.precision,
            h=v.h,
        )
        self._size = group, self._n_chunks
        self._reweigh_size = group, planes.shape[1], b.n_free

    def follow(self, pairs, mode):
        """Uploads the mode (B,) of each scene, REST, NEXT, ..., and the slots of its pairs."""
        plan = np.empty(self._plan.shape, np.int32)
        plan[:, 0], plan[:, 1], plan[:, 2] = mode, pairs.used, pairs.spare
        self._send(plan, self._plan)

    def _send(self, values, array):
        """Queues an upload that ends before the next sums come back."""
        self._sent.append(self._buffers.device.upload(values, array, wait=False))

    def queue_products(self):
        """Queues the inner products of trials; s and H y go into the spare slots."""
        self._trial(self._size)
        for size, given in self._levels:
            self._invert(size, **given)
        if self._directions is not None:
            by_direction, by_variable = self._directions
            self._multiply_directions(by_direction)
            self._add_directions(by_variable)
        self._change(self._size)

    def products(self, *others):
        """The inner products last queued, for idle scenes the former ones.

        s_k . P g, H y_k . P g, s_k . y, H y_k . y (B, slots, 4), g . s (B,), x_new . precision
        x_new (B,). Then the values of `others`, device arrays that are read in the same wait.
        """
        sums, *others = self._buffers.device.get_all([self._sums, *others])
        self._sent.clear()
        sums = np.add.reduceat(sums.astype(np.float64), self._first_chunks, axis=0)
        products = sums[:, :-2].reshape(len(sums), self._n_slots, 4)
        return products, sums[:, -2], sums[:, -1], *others

    def advance(self, a, c, scale, length):
        """Queues the next trials: a, c (B, slots), scale, length (B,)."""
        table, n = np.empty(self._coefficients.shape, self._buffers.dtype), self._n_slots
        table[:, :n], table[:, n : 2 * n], table[:, -2], table[:, -1] = a, c, scale, length
        self._send(table, self._coefficients)
        self._advance(self._size)

    def reweigh(self, light, weights):
        """Queues h and g_new of other strengths.

        light, weights: see PriorStrengths. Earlier pairs are kept, because the curvature of chi2
        does not change; without them fits take a tenth more rounds.
        """
        b = self._buffers
        if b.n_free:
            self._reweigh(self._reweigh_size, light=light, weights=b.put(weights))

    def take_blocks(self, blocks, exchanges=()):
        """Sets the SourceBlocks of all sources (S).

        exchanges: the ExchangeDirections of each scene (B)
        """
        b = self._buffers
        start, scene = self._latents.start, b.host_boxes.scene
        self._levels = []
        directions = [some.direction for some in blocks], list(exchanges)
        if directions != self._directions_of:  # as objects
            self._directions_of = directions
            self._set_directions(self._placed(*directions))
        listed = [(s, block) for s, some in enumerate(blocks) for block in some.blocks]
        self.shelf.retain([block for _, block in listed])
        for level in range(1 + max((block.level for _, block in listed), default=-1)):
            own = [(s, block) for s, block in listed if block.level == level]
            sizes = [len(block.indices) for _, block in own]
            table = [[scene[s] for s, _ in own], sizes, np.cumsum([0, *sizes[:-1]])]
            table.append([self.shelf.first(block) // ALIGN for _, block in own])
            places = np.concatenate([start[s] + block.indices for s, block in own])
            given = {
                "blocks": b.device.put(np.stack(table, axis=1), np.int32),
                "indices": b.device.put(places, np.int32),
                "roots": self.shelf.values,
                "more": level > 0,
            }
            self._levels.append(((self._size[0] * len(own),), given))

    def _placed(self, of_sources, exchanges):
        """The scene, places (k,) and values (k,) of each direction."""
        b, start = self._buffers, self._latents.start
        own = [(s, d.values) for s, d in enumerate(of_sources) if d]
        found = [(b.host_boxes.scene[s], start[s] + np.arange(len(d)), d) for s, d in own]
        for i, (some, at) in enumerate(zip(exchanges, b.host_first, strict=False)):
            for d in some:
                spectra, moving = d.spectra.ravel(), np.flatnonzero(d.spectra)
                both = start[at + d.source] + d.places, self._sizes[i, 1][0] + moving
                found.append((i, np.concatenate(both), np.append(d.values, spectra[moving])))
        return found

    def _set_directions(self, directions):
        """Uploads directions (scene, places (k,), values (k,))."""
        b, self._directions = self._buffers, None
        if not directions:
            return
        scene, places, values = zip(*directions, strict=True)
        lengths = [len(at) for at in places]
        of = np.repeat(np.arange(len(scene)), lengths)
        places, values = np.concatenate(places), np.concatenate(values)
        both = {"owner": b.device.put(np.array(scene), np.int32)}
        both["totals"] = b.device.empty((len(scene), 2), b.dtype)
        self._multiply_directions.bind(
            **both,
            ends=b.device.put(np.cumsum([0, *lengths]), np.int32),
            places=b.device.put(places, np.int32),
            d=b.put(values),
        )
        runs, order, firsts = _runs(places, of)
        n = len(runs) - 1
        self._add_directions.bind(
            **both,
            n=n,
            runs=b.device.put(runs, np.int32),
            of=b.device.put(of[order[firsts]], np.int32),
            values=b.put(values[order]),
        )
        launched = round_up(n * self._lanes, *b.tuning.local_size(1))
        self._directions = (self._size[0] * len(scene),), (launched,)


def _runs(places, of):
    """Runs (n + 1, 4) of variables side by side in the same directions, see block_inverse.cl.

    places, of (k,): variable and direction of each element

    Also returns the elements (k,) in the order of the runs, and those of them (m,) with which a
    direction of a run begins.
    """
    order = np.argsort(places, kind="stable")
    sorted_places, of, at = places[order], of[order], np.arange(len(order))
    first = np.flatnonzero(np.diff(sorted_places, prepend=-1))
    variables, count = sorted_places[first], np.diff(first, append=len(order))
    owner = np.repeat(np.arange(len(variables)), count)
    # elements whose direction is not that of the next variable's element in the same place
    after = np.minimum(at + count[owner], len(at) - 1)
    unlike = np.add.reduceat(of[after] != of, first) > 0
    joined = (np.diff(variables) == 1) & (np.diff(count) == 0) & ~unlike[:-1]
    joined &= variables[1:] % MAX_RUN != 0
    start = np.flatnonzero(np.append(True, ~joined))
    length = np.diff(start, append=len(variables))
    run = np.repeat(np.arange(len(start)), length)[owner]
    direction, variable = at - first[owner], owner - start[run]
    to = first[start][run] + direction * length[run] + variable
    ordered = np.empty_like(order)
    ordered[to] = order
    terms = np.cumsum([0, *count[start]])
    rows = [variables[start], length, terms[:-1], first[start]]
    runs = np.column_stack([np.append(row, 0) for row in rows])
    runs[-1, 2:] = terms[-1], len(order)
    return runs, ordered, np.sort(to[variable == 0])
