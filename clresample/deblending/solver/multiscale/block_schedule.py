"""Blocks of inverse curvature, made in threads while the rounds go on with the former ones."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from ....device.multi_device import host_threads
from .inverse import SourceBlocks

# [rounds] of a scene between new strengths and the blocks that follow from them: a fixed number,
# so that quick and slow threads give the same fit. With 0 the device waits for the threads.
BLOCK_DELAY_ROUNDS = 1


class BlockSchedule:
    """The present blocks of a batch's sources, and those that are being made.

    inverses (S): each source's BlockPreconditioner, None of fixed ones
    scene (S,): that of each source

    blocks (S): SourceBlocks of each source
    """

    def __init__(self, inverses, scene, device):
        self._inverses, self._scene = inverses, scene
        n_threads = host_threads(device)
        self._pool = ThreadPoolExecutor(n_threads) if n_threads > 1 else None
        self.blocks = [SourceBlocks()] * len(inverses)
        self._waiting = {}  # source: round of its scene from which on its blocks count, Future

    def subset(self, sources, scene):
        """Those of the sources (n,) alone, which are of the scenes (n,) now."""
        new = object.__new__(BlockSchedule)
        new._inverses, new._scene = [self._inverses[s] for s in sources], scene
        new._pool, new.blocks = self._pool, [self.blocks[s] for s in sources]
        new._waiting = {i: self._waiting[s] for i, s in enumerate(sources) if s in self._waiting}
        return new

    def request(self, sources, strengths, spectra, rounds):
        """Has the blocks of these sources made; they count BLOCK_DELAY_ROUNDS later.

        strengths (S, J), spectra (S, C): those that the blocks are for
        rounds (B,): of each scene so far
        """
        self.take(rounds, [s for s in sources if s in self._waiting])
        for s in sources:
            given = strengths[s].copy(), spectra[s].copy()
            future = self._submit(self._inverses[s].blocks, *given)
            self._waiting[s] = rounds[self._scene[s]] + BLOCK_DELAY_ROUNDS, future

    def take(self, rounds, sources=()):
        """Takes the blocks whose time has come, and those of `sources`; returns whether any did.

        rounds (B,): of each scene so far
        """
        due = [s for s, (after, _) in self._waiting.items() if rounds[self._scene[s]] >= after]
        due = [*due, *(s for s in sources if s not in due)]
        for s in due:
            _, future = self._waiting.pop(s)
            self.blocks[s] = future.result()
        return bool(due)

    def _submit(self, function, *given):
        if self._pool is not None:
            return self._pool.submit(function, *given)
        future = Future()
        future.set_result(function(*given))
        return future
