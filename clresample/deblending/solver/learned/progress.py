"""How far each scene of a batch has come, and what it does next: the decisions of L-BFGS."""

from __future__ import annotations

import numpy as np

from .steps import AGAIN, NEXT, REST, STAY, TRY

# A trial is accepted if the loss falls by this part of what the slope promises.
ARMIJO = 1e-4
# Shortest and longest next step after a trial that was not accepted, as parts of it; trials before
# the memory is dropped, and after that before a scene is left where it is.
SHRINK = 0.1, 0.5
TRIALS = 8
# Strengths are learned where a scene's loss fell by less than NEAR, times chi2 per pixel where that
# is above 1, over the last CALM iterations, so that its structure is near that of the present ones;
# at the latest after FIRST rounds, and then EVERY so many, until none moves by more than SETTLED in
# its logarithm.
NEAR, CALM = 5.0, 3
FIRST, EVERY, SETTLED = 16, 8, 0.1
# Whether the finest structure of sources is clear (evidence.py) is asked once strengths have
# settled, where a scene's loss fell by less than this (or `enough`, where that is more: none has
# converged before it is asked), times chi2 per pixel likewise, over the last CALM iterations.
# Earlier, structure still holds what spectra and neighbours will take from it: with 5, more
# simulated galaxies exceed what is clear. With 1 the same ones do, up to 30 iterations later.
LOOK = 2.5
# It is also asked after LATE_LOOK rounds where a scene still falls by FALLING and more over these
# iterations, times chi2 per pixel likewise: blends of large galaxies with clumps fall so for
# hundreds of rounds before they are calm, all of them lost where a second fit takes over. SDRs of
# 32 simulated scenes are the same with it and without (bench.settings).
LATE_LOOK, FALLING = 80, 50.0
# A fit has converged when its strengths have settled and its loss fell by less than `enough` over
# PATIENCE iterations and over the last twelfth of all, at most LONGEST; by that times chi2 per
# pixel where that is above 1: a model that misfits so knows its fluxes less well by its root. Light
# of a small galaxy inside a giant comes back from the giant's structure over hundreds of iterations
# that gain 0.03 each: without the twelfth such fits ended 8 above the lowest loss, and fluxes 6
# errors from the truth (bench.ladder, giant). Fits of up to 60 iterations end as without it.
PATIENCE, TWELFTH, LONGEST = 5, 12, 100


class Progress:
    """Arrays over the scenes of a batch (B,).

    enough: see Settings; n_pixels (B,): observed, with a weight

    live: those that go on; converged, failed: those that have come to their end, failed ones
        because the loss of their start is no number
    loss: of the last accepted trial; n_iterations: accepted trials, the start not counted
    n_rounds: of each scene, trials so far
    settled: scenes whose strengths are; looked: those that know which structure is clear
    """

    def __init__(self, n_scenes, enough, n_pixels):
        n, self.enough, self._n_pixels = n_scenes, enough, np.asarray(n_pixels, float)
        self.live, self.converged, self.failed = (
            np.ones(n, bool),
            np.zeros(n, bool),
            np.zeros(n, bool),
        )
        self.loss = np.full(n, np.inf)
        self.n_iterations, self.n_rounds = np.zeros(n, int), np.zeros(n, int)
        self.settled, self.looked = np.zeros(n, bool), np.zeros(n, bool)
        self._due = np.full(n, FIRST)
        self._fresh = np.ones(n, bool)  # the trial is where the scene is, with another loss
        self._bare = np.zeros(n, bool)  # without pairs since a direction that led nowhere
        self._length, self._trials = np.ones(n), np.zeros(n, int)
        self._losses = np.full((n, LONGEST + 1), np.inf)  # the last ones, the present one first

    def take(self, keep):
        """That of the scenes `keep` (n,) alone."""
        new = Progress(len(keep), self.enough, self._n_pixels[keep])
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(new, name, value[keep])
        return new

    def judge(self, loss, slope):
        """Whether each scene's trial of this loss is accepted: (B,), and which of these have a step
        behind them that says something of the curvature. slope (B,): g . (x_new - x)"""
        self.n_rounds += self.live
        finite = np.isfinite(loss)
        self.failed |= self.live & self._fresh & ~finite
        self.live &= ~self.failed
        with np.errstate(invalid="ignore"):
            lower = (slope < 0) & (loss <= self.loss + ARMIJO * slope)
            shrink = -slope / (2 * np.maximum(loss - self.loss - slope, 1e-30))
        self._shrink = np.clip(np.where(np.isfinite(shrink), shrink, 0), *SHRINK)
        self._uphill = ~(slope < 0)
        accepted = self.live & finite & (lower | self._fresh)
        stepped = accepted & ~self._fresh
        self._losses[stepped] = np.roll(self._losses[stepped], 1, axis=1)
        self.n_iterations += stepped
        self._losses[accepted, 0] = self.loss[accepted] = loss[accepted]
        self._fresh &= ~accepted
        return accepted, stepped

    def due(self, accepted):
        """Which scenes (B,) learn their strengths now."""
        calm = self._fallen(CALM) < NEAR * self.chi2()
        return accepted & ~self.settled & (calm | (self.n_rounds >= self._due))

    def asks(self, accepted):
        """Which scenes (B,) look now for structure that is clear."""
        fall, chi2 = self._fallen(CALM), self.chi2()
        calm = fall < max(LOOK, self.enough) * chi2
        far = (self.n_rounds >= LATE_LOOK) & (fall > FALLING * chi2) & np.isfinite(fall)
        return accepted & self.settled & ~self.looked & (calm | far)

    def answered(self, which, clear):
        """Take down that the scenes `which` (B,) have looked, and where `clear` (B,) is true found
        more: they learn strengths again from now on, and look again after that."""
        self.looked |= which & ~clear
        self.settled &= ~clear
        return clear

    def learned(self, due, moved, change):
        """Take down what the scenes `due` have learned: moved (B,), largest change of a logarithm
        of a strength; change (B,) of their losses."""
        self.loss += np.where(due, change, 0)
        self.settled |= due & (moved < SETTLED)
        self._due[due] = self.n_rounds[due] + EVERY
        self._losses[due, 0], self._losses[due, 1:] = self.loss[due], np.inf

    def look_again(self, which):
        """Of the scenes `which` (B,) the loss is another one now: their next trial is where they
        are."""
        self._fresh |= which
        self._bare &= ~which
        self._call_back(which)

    def go_on(self, which):
        """Let the scenes `which` (B,) try a step that was not theirs, also those that have
        converged."""
        self._call_back(which)
        self._length[which], self._trials[which] = 1.0, 0

    def _call_back(self, which):
        """The scenes `which` (B,) go on, whatever they had gained."""
        self._losses[which, 1:] = np.inf
        self.converged &= ~which
        self.live |= which

    def next(self, accepted):
        """Mode (B,) and length (B,) of each scene's next step, and which drop their pairs (B,)."""
        enough = self.enough * self.chi2()
        patience = np.clip(self.n_iterations // TWELFTH, PATIENCE, LONGEST)
        calm = (self._fallen(PATIENCE) < enough) & (self._fallen(patience) < enough)
        self.converged |= accepted & self.settled & calm
        self.live &= ~self.converged
        refused = self.live & ~accepted
        self._trials = np.where(refused, self._trials + 1, 0)
        self._length = np.where(refused, self._length * self._shrink, 1.0)
        lost = refused & (self._uphill | (self._trials >= TRIALS))
        bare, stuck = lost & ~self._bare, lost & self._bare
        self._length[bare], self._trials[bare] = 1.0, 0
        self._bare = (self._bare & ~accepted) | bare
        # No step lowers the loss: all that its rounding lets see has been reached. Strengths are
        # learned from here, or the fit has converged.
        self.converged |= stuck & self.settled
        self.live &= ~self.converged
        stuck &= self.live
        self._due[stuck] = 0
        self._fresh |= stuck
        mode = np.full(len(accepted), REST)
        for which, what in ((refused, TRY), (bare, AGAIN), (stuck, STAY), (accepted, NEXT)):
            mode[which] = what
        mode[~self.live & ~accepted] = REST
        return mode, self._length, bare

    def _fallen(self, n):
        """By how much the losses (B,) fell over the last n iterations, a number or (B,)."""
        before = np.take_along_axis(self._losses, np.broadcast_to(n, len(self.loss))[:, None], 1)
        with np.errstate(invalid="ignore"):  # of scenes without a loss so far
            return before[:, 0] - self._losses[:, 0]

    def chi2(self):
        """chi2 per pixel (B,), at least 1."""
        return np.maximum(1, 2 * self.loss / self._n_pixels)
