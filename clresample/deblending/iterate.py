"""The loop of a batch of fits: steps, stops, shifts, and boxes resized to the light they hold."""

from __future__ import annotations

import time

import numpy as np

from .resize import resized
from .solver.engine import Engine

# [iterations] between two looks at the losses: each waits for the device, but fits stop only there.
CHECK = 5
# [iterations] between two shifts of the observations: by then the model has followed most of the
# last one. Fewer would measure a shift on a model that lags behind, more would take longer.
MOVE = 10
# Part of a batch's fits that have stopped by when the others go on in a smaller batch: making that
# costs some iterations, and until then the stopped ones are still computed.
REPACK = 0.25
# [iterations] between two adjustments of the boxes to the light they hold; each makes a new batch.
RESIZE = 40


def iterate(fits, settings, device, dtype, progress=None):
    """Run the fits of one signature until each has stopped; they keep their final states."""
    began, running = time.perf_counter(), None
    try:
        running = _Running(fits, settings, device, dtype)
        for _ in range(0, settings.max_iter, CHECK):
            losses = running.run()
            if progress is not None:
                progress(running.engine.n_steps, losses[-1])
            if not running.live.any():
                break
            running.shift()
            running = running.repacked()
    except KeyboardInterrupt:
        for f in running.going() if running else fits:
            f.interrupt()
        if running:
            running.settle(running.live)
    for f in fits:
        f.note_seconds("fit", (time.perf_counter() - began) / len(fits))


class _Running:
    """The fits of one engine, on their way.

    fits (B): in the engine's order; live (B,): those that have not stopped
    """

    def __init__(self, fits, settings, device, dtype, scenes=None, states=None):
        self.fits, self.settings, self.device, self.dtype = list(fits), settings, device, dtype
        self.live = np.ones(len(self.fits), bool)
        self.engine = Engine(
            scenes or [f.scene for f in self.fits],
            states or [f.state for f in self.fits],
            device,
            dtype,
            chain=settings.constraints,
            prior=settings.prior,
            step_sizes=settings.step_sizes,
        )

    def going(self):
        """The fits that have not stopped."""
        return [f for f, on in zip(self.fits, self.live, strict=True) if on]

    def run(self):
        """Some iterations, after which fits may have stopped; their losses (n, B)."""
        engine, max_iter = self.engine, self.settings.max_iter
        losses = engine.run(min(CHECK, max_iter - engine.n_steps))
        stop = np.zeros(len(self.fits), bool)
        for i in np.flatnonzero(self.live):
            stop[i] = self.fits[i].stopped(losses[:, i])
        if engine.n_steps >= max_iter:
            stop = self.live.copy()
        if stop.any():
            self.settle(stop)
            self.live &= ~stop
        return losses

    def remember(self, which):
        """Bring the states kept on the device to those of the fits (B,) that had none better."""
        losses, kept = self.engine.best_losses(), self.engine.states(kept=True)
        for i in np.flatnonzero(which):
            self.fits[i].remember(losses[i], self.engine.scenes[i], kept[i])

    def settle(self, stop):
        """Leave the fits (B,) that stop here with their final state and its loss."""
        self.remember(stop)
        states, losses = self.engine.states(), self.engine.final_losses()
        for i in np.flatnonzero(stop):
            self.fits[i].settle(losses[i], self.engine.scenes[i], states[i])

    def shift(self):
        """Shift the observations, where that is asked for and due."""
        if not self.settings.fit_shifts or self.engine.n_steps % MOVE:
            return
        self.remember(self.live)
        states = self.engine.states()
        for i in np.flatnonzero(self.live):
            self.fits[i].move(self.engine.scenes[i], states[i])
        self.engine.follow_shifts()

    def repacked(self) -> _Running:
        """What goes on: itself, or a new batch where boxes change or enough fits have stopped."""
        engine, resize = self.engine, self.engine.n_steps % RESIZE == 0
        if not resize and (~self.live).mean() < REPACK:
            return self
        states, going = engine.states(), np.flatnonzero(self.live)
        pairs = [(engine.scenes[i], states[i]) for i in going]
        if resize:
            fits = [self.fits[i] for i in going]
            pairs = [resized(*pair, f.profiles, f.noise) for f, pair in zip(fits, pairs)]
        same = [scene is engine.scenes[i] for i, (scene, _) in zip(going, pairs)]
        if all(same) and len(going) == len(self.fits):
            return self
        self.remember(self.live)
        scenes, states = map(list, zip(*pairs, strict=True))
        return _Running(self.going(), self.settings, self.device, self.dtype, scenes, states)
