"""The loop of a batch of fits: steps, stops, shifts, and boxes resized to the light they hold."""

from __future__ import annotations

import contextlib
import time

import numpy as np

from .blend import STOPPED_FOR_REFIT
from .posterior.joint_step import make_joint_step, solve_joint_step
from .resize import resize_boxes
from .shifts import extrapolate, shift_steps
from .solver.engine import Engine
from .solver.multiscale.engine import MultiscaleEngine
from .solver.multiscale.lbfgs_control import CONVERGENCE_WINDOW

# [iterations] between two looks at the losses: each waits for the device, but fits stop only there.
CHECK_ITERATIONS = 5
# [iterations] between two shifts of the observations: by then the model has followed most of the
# last one. Fewer would measure a shift on a model that lags behind, more would take longer.
SHIFT_ITERATIONS = 10
# Part of a batch's fits that have stopped by when the others go on in a smaller batch: making that
# costs some iterations, and until then the stopped ones are still computed.
REPACK_FRACTION = 0.25
# A fit under a MultiscalePrior stays where it is if the next shift would lower its loss by less
# than this part of what ends it.
MIN_GAIN = 0.5
# [iterations] When a fit with settled strengths takes a step of its JointNewtonStep: at first, and
# between two; also where it has converged. Every 40 of them, bright scenes take a third longer.
FIRST_JOINT_STEP, JOINT_STEP_ITERATIONS = 40, 20
# It takes the step if its loss is expected to fall by more than this part of what ends it. With
# 0.4, two in 100 fluxes of simulated scenes of Rubin's or Euclid's alone move by over 0.2 errors
# where fits go on, with 0.2 one in 200.
MIN_JOINT_GAIN = 0.2
# If the loss has fallen by less than this part of the predicted gain until the next one, the
# JointNewtonStep is made anew, of the present scene. The second one is given up: bounds hold the
# scene elsewhere, and trials along its steps would be rejected.
MIN_JOINT_PROGRESS, MAX_JOINT_MATRICES = 0.2, 2
# [iterations] between two adjustments of the boxes to the light they hold; each makes a new batch.
RESIZE_ITERATIONS = 40


def iterate(fits, settings, device, dtype, progress=None, *, takes_over=None):
    """Runs the fits of one signature until each has stopped; they keep their final states.

    takes_over: of a fit that has learned clear structure; where True the fit ends,
        STOPPED_FOR_REFIT
    """
    began, running = time.perf_counter(), None
    try:
        given = fits, settings, device, dtype
        running = (
            _LbfgsRun(*given, takes_over=takes_over)
            if settings.has_multiscale_prior
            else _AmsgradRun(*given)
        )
        while running.n_steps < settings.max_iter:
            losses = running.run()
            if progress is not None:
                progress(running.n_steps, losses[-1])
            if not running.live.any():
                break
            running.shift()
            running = running.repacked()
    except KeyboardInterrupt:
        handed_over = [f for f in fits if f.status == STOPPED_FOR_REFIT]
        for f in handed_over + (running.going() if running else fits):
            f.interrupt()
        if running:
            running.settle(running.live)
    for f in fits:
        f.note_seconds("fit", (time.perf_counter() - began) / len(fits))


class _AmsgradRun:
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
        return [f for f, on in zip(self.fits, self.live, strict=True) if on]

    def run(self):
        """Some iterations, after which fits may have stopped; their losses (n, B)."""
        engine, max_iter = self.engine, self.settings.max_iter
        losses = engine.run(min(CHECK_ITERATIONS, max_iter - engine.n_steps))
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
        """Copies the best states from the device to the fits (B,), if better than their own."""
        losses, kept = self.engine.best_losses(), self.engine.states(kept=True)
        for i in np.flatnonzero(which):
            self.fits[i].keep_best(losses[i], self.engine.scenes[i], kept[i])

    def settle(self, stop):
        """Stores the final state and loss of the fits (B,) that stop here."""
        self.remember(stop)
        states, losses = self.engine.states(), self.engine.final_losses()
        for i in np.flatnonzero(stop):
            self.fits[i].store_final(losses[i], self.engine.scenes[i], states[i])

    def shift(self):
        """Updates the observations' shifts if they are fitted and due."""
        if not self.settings.fit_shifts or self.engine.n_steps % SHIFT_ITERATIONS:
            return
        self.remember(self.live)
        states = self.engine.states()
        for i in np.flatnonzero(self.live):
            f = self.fits[i]
            f.shift(f.shifts + shift_steps(self.engine.scenes[i], states[i])[0])
        self.engine.update_shifts()

    def repacked(self) -> _AmsgradRun:
        """Returns itself, or a new batch where boxes change or enough fits have stopped."""
        engine, resize = self.engine, self.engine.n_steps % RESIZE_ITERATIONS == 0
        if not resize and (~self.live).mean() < REPACK_FRACTION:
            return self
        states, going = engine.states(), np.flatnonzero(self.live)
        pairs = [(engine.scenes[i], states[i]) for i in going]
        if resize:
            fits = [self.fits[i] for i in going]
            pairs = [resize_boxes(*pair, f.start, f.noise) for f, pair in zip(fits, pairs)]
        same = [scene is engine.scenes[i] for i, (scene, _) in zip(going, pairs)]
        if all(same) and len(going) == len(self.fits):
            return self
        self.remember(self.live)
        scenes, states = map(list, zip(*pairs, strict=True))
        return _AmsgradRun(self.going(), self.settings, self.device, self.dtype, scenes, states)


class _LbfgsRun:
    """The fits of one engine under a MultiscalePrior, on their way; else as _AmsgradRun.

    Boxes stay as they are: structure fades at their edges, as the profile does that they follow.

    exchanges (B): each fit's JointNewtonStep, or None; asked (B, 4): when that was last looked at
        a fit's rounds and loss, 0 and infinite before, the gain that it promised, and how many
        were made
    stop_for_refit: see `iterate`
    """

    def __init__(self, fits, settings, device, dtype, past=None, *, takes_over=None):
        self.fits, self.settings, self.device, self.dtype = list(fits), settings, device, dtype
        self.stop_for_refit = takes_over
        if past is None:
            self.exchanges = [None] * len(fits)
            self.asked = np.tile([0, np.inf, 0, 0], (len(fits), 1))
            scenes, states = [f.scene for f in fits], [f.state for f in fits]
            self.engine = MultiscaleEngine(
                scenes, states, device, dtype, settings.prior, settings.loss_tol
            )
        else:
            self.engine, self.exchanges, self.asked = past

    @property
    def live(self):
        """The fits (B,) that have not stopped."""
        return self.engine.progress.live

    @property
    def n_steps(self) -> int:
        """Trials so far, each of which is an iteration or a step that was too long."""
        return max(int(self.engine.progress.n_rounds.max()) - 1, 0)

    def going(self):
        """The fits that have not stopped."""
        return [f for f, on in zip(self.fits, self.live, strict=True) if on]

    def run(self):
        """Some iterations, after which fits may have stopped; their losses (1, B)."""
        engine, live = self.engine, self.live.copy()
        n_steps = min(self.n_steps + CHECK_ITERATIONS, self.settings.max_iter)
        while self.n_steps < n_steps and self.live.any():
            looked = engine.progress.tested.copy()
            for i in np.flatnonzero(engine.round()):
                self.fits[i].losses.append(float(engine.progress.loss[i]))
            live &= ~self._handed_over(live & engine.progress.tested & ~looked)
            self._exchange(live)
        if self.settings.fit_shifts and self.n_steps < self.settings.max_iter:
            self._move(live & engine.progress.converged)
        over = self.live if self.n_steps >= self.settings.max_iter else np.zeros_like(live)
        stop = (live & ~self.live) | over
        if stop.any():
            self.settle(stop)
            engine.progress.live &= ~over
        return engine.progress.loss[None]

    def shift(self):
        """Updates the observations' shifts if they are fitted and due."""
        if self.settings.fit_shifts and self.n_steps % SHIFT_ITERATIONS == 0:
            self._move(self.live)

    def _move(self, which):
        """Updates the shifts of the fits (B,); converged fits continue."""
        if not which.any():
            return
        states, moved = self.engine.states(which), np.zeros(len(self.fits), bool)
        enough = self.settings.loss_tol * self.engine.progress.chi2()
        for i in np.flatnonzero(which):
            steps, gain = shift_steps(self.engine.scenes[i], states[i])
            moved[i] = gain > MIN_GAIN * enough[i]
            if moved[i]:
                f = self.fits[i]
                f.shift(f.shifts + extrapolate(steps, f.last_steps))
                f.last_steps = steps
        if moved.any():
            self.engine.update_shifts(moved)

    def _handed_over(self, which):
        """Those of the fits (B,) that end here, since another one takes their scene over."""
        if not which.any() or self.stop_for_refit is None:
            return np.zeros_like(which)
        which = which & self.engine.strengths.significant_scenes()
        if which.any():
            self.settle(which)
        for i in np.flatnonzero(which):
            which[i] = self.stop_for_refit(self.fits[i])
            if which[i]:
                self.fits[i].status = STOPPED_FOR_REFIT
        self.engine.progress.live &= ~which
        return which

    def _exchange(self, which):
        """Takes the joint step of those fits (B,) whose time has come, if it gains enough.

        Those that have converged then go on.
        """
        engine, p = self.engine, self.engine.progress
        enough = MIN_JOINT_GAIN * self.settings.loss_tol * p.chi2()
        rounds, loss, promised, made = self.asked.T
        there = np.array([e is not None for e in self.exchanges])
        due = p.n_rounds >= np.maximum(rounds + JOINT_STEP_ITERATIONS, FIRST_JOINT_STEP)
        with np.errstate(invalid="ignore"):  # of a fit whose loss was never a number
            fallen = loss - p.loss
        failed = there & (fallen < MIN_JOINT_PROGRESS * promised)
        old = failed & (made < MAX_JOINT_MATRICES)
        ready = p.converged | (p.live & p.settled & p.tested & due)
        which = which & ready & ((fallen > enough) | old)
        if not which.any() or self.n_steps + CONVERGENCE_WINDOW >= self.settings.max_iter:
            return  # a fit takes that long to converge again
        new = which & ((made == 0) | old)
        self.asked[which] = np.stack([p.n_rounds, p.loss, 0 * p.loss, made + new], 1)[which]
        for i in np.flatnonzero(which & failed):
            self.exchanges[i] = None
        if new.any():
            states, findings = engine.states(new), engine.findings(new)
            for i in np.flatnonzero(new):
                given = engine.scenes[i], states[i], findings[i]
                with contextlib.suppress(np.linalg.LinAlgError):
                    self.exchanges[i] = make_joint_step(self.fits[i], *given)
        which &= np.array([e is not None for e in self.exchanges])
        slopes, steps = engine.slopes(which) if which.any() else (), {}
        for i in np.flatnonzero(which):
            step, gain = solve_joint_step(self.exchanges[i], slopes[i])
            if step is None:
                self.exchanges[i] = None
            elif gain > enough[i]:
                steps[i], self.asked[i, 2] = step, gain
        if steps:
            engine.step(steps)

    def settle(self, stop):
        """Stores the present state of the fits (B,) that stop here."""
        states, p = self.engine.states(stop), self.engine.progress
        findings = self.engine.findings(stop)
        for i in np.flatnonzero(stop):
            f, ended = self.fits[i], "diverged" if p.failed[i] else "converged"
            status = ended if p.failed[i] or p.converged[i] else f.status
            f.end(self.engine.scenes[i], states[i], findings[i], status)

    def repacked(self) -> _LbfgsRun:
        """Returns itself, or a new batch where boxes change or enough fits have stopped."""
        if (~self.live).mean() < REPACK_FRACTION:
            return self
        keep = np.flatnonzero(self.live)
        fits, exchanges = ([some[i] for i in keep] for some in (self.fits, self.exchanges))
        past = self.engine.subset(keep), exchanges, self.asked[keep]
        given = fits, self.settings, self.device, self.dtype, past
        return _LbfgsRun(*given, takes_over=self.stop_for_refit)
