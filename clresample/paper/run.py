"""Fits by the paper's solver on their way: steps, stops, shifts, boxes that follow the light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..deblending.ended import Ended
from ..deblending.iterate import CHECK_ITERATIONS, REPACK_FRACTION, SHIFT_ITERATIONS
from ..deblending.shifts import shift_steps
from .resize import resize_boxes
from .solver.engine import Engine
from .solver.scene import AmsgradScene, AmsgradState, begin_steps

# The stopping rule compares the best loss with the best one this many iterations ago: losses of
# single iterations scatter, and a smaller number would take a pause for the end.
PATIENCE = 15
# A loss this many times the best one, or NaN, is a divergence.
DIVERGENCE_RATIO = 10.0
# [iterations] between two adjustments of the boxes to the light they hold; each makes a new batch.
RESIZE_ITERATIONS = 40


def start_run(fits, settings, device, dtype) -> AmsgradRun:
    """The run of fits of one signature that have begun; settings: PaperSettings."""
    pairs = [begin_steps(f.scene, f.state, settings.prior) for f in fits]
    return AmsgradRun([FitTrack(f, settings.rel_tol) for f in fits], settings, device, dtype, pairs)


class AmsgradRun:
    """The fits of one engine by AMSGrad, on their way.

    tracks (B): of the fits, in the engine's order; live (B,): those that have not stopped
    """

    def __init__(self, tracks, settings, device, dtype, pairs):
        self.tracks, self.settings, self.device, self.dtype = tracks, settings, device, dtype
        self.live = np.ones(len(tracks), bool)
        scenes, states = map(list, zip(*pairs, strict=True))
        self.engine = Engine(
            scenes,
            states,
            device,
            dtype,
            chain=settings.constraint_chain,
            prior=settings.prior,
            step_sizes=settings.step_sizes,
        )

    @property
    def n_steps(self) -> int:
        """Iterations done so far."""
        return self.engine.n_steps

    def going(self):
        """The fits that have not stopped."""
        return [t.fit for t, on in zip(self.tracks, self.live, strict=True) if on]

    def run(self):
        """Some iterations, after which fits may have stopped; their losses (n, B)."""
        engine, max_iter = self.engine, self.settings.max_iter
        losses = engine.run(min(CHECK_ITERATIONS, max_iter - engine.n_steps))
        stop = np.zeros(len(self.tracks), bool)
        for i in np.flatnonzero(self.live):
            stop[i] = self.tracks[i].stopped(losses[:, i])
        if engine.n_steps >= max_iter:
            stop = self.live.copy()
        if stop.any():
            self.settle(stop)
            self.live &= ~stop
        return losses

    def remember(self, which):
        """Copies the best states from the device to the tracks (B,), if better than their own."""
        losses, kept = self.engine.best_losses(), self.engine.states(kept=True)
        for i in np.flatnonzero(which):
            self.tracks[i].keep_best(losses[i], self.engine.scenes[i], kept[i])

    def settle(self, stop):
        """Stores the final state and loss of the fits (B,) that stop here."""
        self.remember(stop)
        states, losses = self.engine.states(), self.engine.final_losses()
        for i in np.flatnonzero(stop):
            self.tracks[i].store_final(losses[i], self.engine.scenes[i], states[i])

    def shift(self):
        """Updates the observations' shifts if they are fitted and due."""
        if not self.settings.fit_shifts or self.engine.n_steps % SHIFT_ITERATIONS:
            return
        self.remember(self.live)
        states = self.engine.states()
        for i in np.flatnonzero(self.live):
            f = self.tracks[i].fit
            f.shift(f.shifts + shift_steps(self.engine.scenes[i], states[i])[0])
        self.engine.update_shifts()

    def repacked(self) -> AmsgradRun:
        """Returns itself, or a new batch where boxes change or enough fits have stopped."""
        engine, resize = self.engine, self.engine.n_steps % RESIZE_ITERATIONS == 0
        if not resize and (~self.live).mean() < REPACK_FRACTION:
            return self
        states, going = engine.states(), np.flatnonzero(self.live)
        pairs = [(engine.scenes[i], states[i]) for i in going]
        if resize:
            fits = [self.tracks[i].fit for i in going]
            pairs = [resize_boxes(*pair, f.start, f.noise) for f, pair in zip(fits, pairs)]
        same = [scene is engine.scenes[i] for i, (scene, _) in zip(going, pairs)]
        if all(same) and len(going) == len(self.tracks):
            return self
        self.remember(self.live)
        tracks = [self.tracks[i] for i in going]
        return AmsgradRun(tracks, self.settings, self.device, self.dtype, pairs)


@dataclass(frozen=True, eq=False)
class _BestState:
    """The lowest loss so far, with its scene, state and shifts."""

    loss: float
    scene: AmsgradScene | None
    state: AmsgradState | None
    shifts: np.ndarray


class FitTrack:
    """Losses and best state of one Fit; rel_tol: see PaperSettings."""

    def __init__(self, fit, rel_tol):
        self.fit, self.rel_tol = fit, rel_tol
        self._best = _BestState(np.inf, None, None, fit.shifts)

    def stopped(self, losses) -> bool:
        """Records the losses (n,) of the last iterations; returns True if the fit stops."""
        fit = self.fit
        fit.losses.extend(losses.tolist())
        reason = stop_reason(fit.losses, len(losses), self.rel_tol)
        fit.status = reason or fit.status
        return reason is not None

    def keep_best(self, loss, scene, state):
        """Keeps a state, at the present shifts, if its loss is the lowest so far."""
        if loss < self._best.loss:
            self._best = _BestState(float(loss), scene, state, self.fit.shifts)

    def store_final(self, loss, scene, state):
        """Ends the fit with the present state, or with the best one if that is better.

        The present one, if it was interrupted, may be half-way through an iteration.
        """
        fit, best = self.fit, self._best
        if fit.status == Ended.INTERRUPTED or not loss <= best.loss:
            if best.state is None:
                return
            loss, scene, state = best.loss, best.scene, best.state
            if not np.array_equal(best.shifts, fit.shifts):
                fit.shift(best.shifts)
        fit.end(scene, state, None, fit.status)
        fit.losses.append(float(loss))


def stop_reason(losses, n_new, tol) -> Ended | None:
    """The stopping rule: DIVERGED, CONVERGED, or None to go on.

    losses: of all iterations so far, of which the last n_new are new; tol: PaperSettings.rel_tol
    """
    best = np.nanmin(losses) if np.isfinite(losses[-n_new:]).all() else np.nan
    if np.isnan(best) or losses[-1] > DIVERGENCE_RATIO * best:
        return Ended.DIVERGED
    if len(losses) > PATIENCE and min(losses[:-PATIENCE]) - best < tol * best:
        return Ended.CONVERGED
    return None
