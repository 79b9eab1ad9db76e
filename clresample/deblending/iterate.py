"""The loop of a batch of fits: steps, stops, shifts, and smaller batches as fits stop."""

from __future__ import annotations

import contextlib
import time

import numpy as np

from ..device.multi_device import host_threads, map_threads
from .assessment.unsettled import fluxes_of, keeps_fluxes
from .ended import Ended
from .posterior.joint_step import make_joint_step, solve_joint_step
from .shifts import extrapolate, shift_steps
from .solver.multiscale.engine import MultiscaleEngine
from .solver.multiscale.lbfgs_control import CONVERGENCE_WINDOW

# [iterations] between two checks of the losses: each waits for the device, and fits stop only
# there.
CHECK_ITERATIONS = 5
# [iterations] between two shifts of the observations: the model has then followed most of the last
# one. With fewer, a shift would be measured on a lagging model; more would take longer.
SHIFT_ITERATIONS = 10
# Fraction of stopped fits at which the others continue in a smaller batch. Making it costs the time
# of some iterations; until then the stopped fits are still computed.
REPACK_FRACTION = 0.25
# A fit with a MultiscalePrior is not shifted if the next shift would lower its loss by less than
# this fraction of Settings.loss_tol.
MIN_GAIN = 0.5
# [iterations] of a fit with settled strengths before its first JointNewtonStep, and between two; a
# converged fit takes one too. With one every 40 iterations, bright scenes take a third longer.
FIRST_JOINT_STEP, JOINT_STEP_ITERATIONS = 40, 20
# The step is taken if the predicted decrease of the loss exceeds this fraction of
# Settings.loss_tol. With 0.4, two in 100 fluxes of simulated scenes of Rubin or Euclid alone change
# by over 0.2 errors if the fits are continued; with 0.2, one in 200.
MIN_JOINT_GAIN = 0.2
# If the loss has fallen by less than this fraction of the predicted gain until the next step, a new
# JointNewtonStep is computed from the present scene. If that one fails too, no more are tried: the
# scene is then limited by bounds, and further steps would be rejected.
MIN_JOINT_PROGRESS, MAX_JOINT_MATRICES = 0.2, 2


def iterate(fits, settings, device, dtype, progress=None, *, takes_over=None):
    """Runs the fits of one signature until each has stopped; they keep their final states.

    takes_over: called with a fit that has significant structure; if it returns True, the fit ends
        for a refit
    """
    began, running = time.perf_counter(), None
    try:
        running = settings.start_run(fits, device, dtype, takes_over)
        while running.n_steps < settings.max_iter:
            losses = running.run()
            if progress is not None:
                progress(running.n_steps, losses[-1])
            if not running.live.any():
                break
            running.shift()
            running = running.repacked()
    except KeyboardInterrupt:
        handed_over = [f for f in fits if f.status == Ended.REFIT]
        for f in handed_over + (running.going() if running else fits):
            f.interrupt()
        if running:
            running.settle(running.live)
    for f in fits:
        f.note_seconds("fit", (time.perf_counter() - began) / len(fits))


class LbfgsRun:
    """The running fits of one engine with a MultiscalePrior.

    Boxes are not resized: structure vanishes at their edges together with the profile.

    fits (B): in the engine's order
    joint_steps (B): each fit's JointNewtonStep, or None
    asked (B, 4): for its last evaluation, the fit's rounds and loss (0 and infinite before), the
        predicted gain, and the number of JointNewtonSteps computed
    stop_for_refit: see `iterate`
    """

    def __init__(self, fits, settings, device, dtype, past=None, *, takes_over=None):
        self.fits, self.settings, self.device, self.dtype = list(fits), settings, device, dtype
        self.stop_for_refit = takes_over
        if past is None:
            for f in fits:
                f.kept_fluxes = []
            self.joint_steps = [None] * len(fits)
            self.asked = np.tile([0, np.inf, 0, 0], (len(fits), 1))
            scenes, states = [f.scene for f in fits], [f.state for f in fits]
            self.engine = MultiscaleEngine(
                scenes, states, device, dtype, settings.prior, settings.loss_tol
            )
        else:
            self.engine, self.joint_steps, self.asked = past

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
        engine, live, begun = self.engine, self.live.copy(), self.n_steps
        n_steps = min(begun + CHECK_ITERATIONS, self.settings.max_iter)
        while self.n_steps < n_steps and self.live.any():
            looked = engine.progress.tested.copy()
            for i in np.flatnonzero(engine.round()):
                self.fits[i].losses.append(float(engine.progress.loss[i]))
            live &= ~self._handed_over(live & engine.progress.tested & ~looked)
            self._take_joint_steps(live)
        if self.settings.fit_shifts and self.n_steps < self.settings.max_iter:
            self._move(live & engine.progress.converged)
        over = self.live if self.n_steps >= self.settings.max_iter else np.zeros_like(live)
        stop = (live & ~self.live) | over
        if stop.any():
            self.settle(stop)
            engine.progress.live &= ~over
        if keeps_fluxes(begun, self.n_steps, self.settings.max_iter) and self.live.any():
            states = engine.states(self.live)
            for i in np.flatnonzero(self.live):
                self.fits[i].kept_fluxes.append(fluxes_of(self.fits[i], states[i]))
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
        """Selects the fits (B,) that end because another fit of their scene replaces them."""
        if not which.any() or self.stop_for_refit is None:
            return np.zeros_like(which)
        which = which & self.engine.strengths.significant_scenes()
        if which.any():
            self.settle(which)
        for i in np.flatnonzero(which):
            which[i] = self.stop_for_refit(self.fits[i])
            if which[i]:
                self.fits[i].status = Ended.REFIT
        self.engine.progress.live &= ~which
        return which

    def _take_joint_steps(self, which):
        """Takes the joint step of those fits (B,) for which it is due, if it gains enough.

        Converged fits then continue.
        """
        engine, p = self.engine, self.engine.progress
        rounds, loss, promised, made = self.asked.T
        due = p.n_rounds >= np.maximum(rounds + JOINT_STEP_ITERATIONS, FIRST_JOINT_STEP)
        which = which & (p.converged | (p.live & p.settled & p.tested & due))
        if not which.any():
            return
        enough = MIN_JOINT_GAIN * self.settings.loss_tol * p.chi2()
        there = np.array([j is not None for j in self.joint_steps])
        with np.errstate(invalid="ignore"):  # fits whose loss was never finite
            fallen = loss - p.loss
        failed = there & (fallen < MIN_JOINT_PROGRESS * promised)
        old = failed & (made < MAX_JOINT_MATRICES)
        which &= (fallen > enough) | old
        if not which.any() or self.n_steps + CONVERGENCE_WINDOW >= self.settings.max_iter:
            return  # a fit needs this many iterations to converge again
        new = which & ((made == 0) | old)
        self.asked[which] = np.stack([p.n_rounds, p.loss, 0 * p.loss, made + new], 1)[which]
        for i in np.flatnonzero(which & failed):
            self.joint_steps[i] = None
        if new.any():
            self._make_joint_steps(new)
        which &= np.array([j is not None for j in self.joint_steps])
        slopes, steps = engine.slopes(which) if which.any() else (), {}
        for i in np.flatnonzero(which):
            step, gain = solve_joint_step(self.joint_steps[i], slopes[i])
            if step is None:
                self.joint_steps[i] = None
            elif gain > enough[i]:
                steps[i], self.asked[i, 2] = step, gain
        if steps:
            engine.step(steps)

    def _make_joint_steps(self, new):
        """Makes the joint steps of the fits `new` (B,), several at a time."""
        states, findings = self.engine.states(new), self.engine.findings(new)

        def make(i):
            with contextlib.suppress(np.linalg.LinAlgError):
                given = self.engine.scenes[i], states[i], findings[i]
                self.joint_steps[i] = make_joint_step(self.fits[i], *given)

        map_threads(host_threads(self.device), make, np.flatnonzero(new))

    def settle(self, stop):
        """Stores the present state of the fits (B,) that stop here."""
        states, p = self.engine.states(stop), self.engine.progress
        findings = self.engine.findings(stop)
        for i in np.flatnonzero(stop):
            f, ended = self.fits[i], Ended.DIVERGED if p.failed[i] else Ended.CONVERGED
            status = ended if p.failed[i] or p.converged[i] else f.status
            f.end(self.engine.scenes[i], states[i], findings[i], status)

    def repacked(self) -> LbfgsRun:
        """Returns itself, or a new batch where enough fits have stopped."""
        if (~self.live).mean() < REPACK_FRACTION:
            return self
        keep = np.flatnonzero(self.live)
        fits, joint_steps = ([some[i] for i in keep] for some in (self.fits, self.joint_steps))
        past = self.engine.subset(keep), joint_steps, self.asked[keep]
        given = fits, self.settings, self.device, self.dtype, past
        return LbfgsRun(*given, takes_over=self.stop_for_refit)
