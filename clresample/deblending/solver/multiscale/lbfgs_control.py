"""Controls the batched L-BFGS: trial steps, strength updates and convergence of each scene."""

from __future__ import annotations

import numpy as np

from .lbfgs_steps import AGAIN, NEXT, REST, STAY, TRY

# A trial is accepted if the loss falls by this fraction of the prediction by the slope.
ARMIJO = 1e-4
# Shortest and longest next step after a rejected trial, relative to it; number of rejected trials
# before the pairs are dropped, and after that before the scene stops.
SHRINK = 0.1, 0.5
MAX_TRIALS = 8
# Strengths are updated if a scene's loss fell by less than STRENGTH_LOSS_DROP, times chi2 per pixel
# if above 1, over the last LOSS_WINDOW iterations, so that the structure has nearly converged for
# the present strengths. The first update is made after FIRST_STRENGTH_ROUND rounds at the latest,
# further ones after STRENGTH_ROUNDS each, until no logarithm changes by more than
# MAX_LOG_STRENGTH_CHANGE.
STRENGTH_LOSS_DROP, LOSS_WINDOW = 5.0, 3
FIRST_STRENGTH_ROUND, STRENGTH_ROUNDS, MAX_LOG_STRENGTH_CHANGE = 16, 8, 0.1
# Strengths are learned in rounds that are a multiple of this, by each scene's own count, unless no
# step lowers the loss: scenes that began together share what such a round costs, 27 learning rounds
# in place of 40 for 32 scenes (bench.throughput), with one iteration more.
COMMON_ROUNDS = 4
# The finest structure of sources is tested for significance (evidence.py) once strengths have
# settled and a scene's loss fell by less than this over the last LOSS_WINDOW iterations, times chi2
# per pixel as above. Twice `loss_tol` is used if it is larger, so that no scene converges before
# its test. Before that, structure contains light that later moves to spectra and neighbours: with
# 5, more simulated galaxies pass. A threshold of 1 selects the same galaxies, up to 30 iterations
# later.
SIGNIFICANCE_LOSS_DROP = 2.5
# A scene is also tested after LATE_LOOK rounds if its loss still falls by FALLING and more over
# these iterations, times chi2 per pixel as above. Losses of large galaxies with clumps fall like
# this for hundreds of rounds, all of them wasted if a second fit follows. SDRs of 32 simulated
# scenes are the same with and without this test (bench.settings).
LATE_LOOK, FALLING = 80, 50.0
# Scenes whose loss is above this for each pixel, of which noise gives half and less, are tested as
# soon as their strengths have settled: strengths count no misfit as structure (evidence.py), and
# stay too weak where the misfit is structure. A blend of `simulate field --sky bright`, seed 1, is
# tested after 31 rounds in place of 87, and after 100 its loss is 64,000 in place of 107,000, in
# the same time. With 0.6 a blend of HSC takes 319 iterations in place of 157 (bench.real), with 1
# mean SDRs fall by 0.03 dB (bench.settings, seed 3000).
MAX_LOSS = 1.5
# [rounds] of a scene before its ExchangeDirections are found, then after twice as many each time:
# most scenes have ended before, and those that last change their light, spectra and bounds on the
# way. New ones make earlier pairs useless. With new ones every 20 rounds and pairs that are kept,
# HSC's blend and HST with HSC take half more core-seconds (bench.real).
FIRST_EXCHANGE_ROUND = 40
# A fit has converged when its strengths have settled, its loss fell by less than `loss_tol` over
# CONVERGENCE_WINDOW iterations, and it would fall by less than a remainder, in units of that, in
# all further ones if its falls over such windows continued as a geometric series. Falls below
# MIN_FALL of the tolerance do not count. The tolerance scales with chi2 per pixel above 1, because
# flux errors grow as its square root. The remainder is MAX_REMAINDER while light of neighbours may
# still move: of four fits of giants with a small galaxy that were continued for 500 rounds, the
# largest fluxes' changes were 1.0, 0.4, 0.2 and 0.2 errors with 1 in its place, and all below 0.02
# with 0.1. LATE_ROUNDS after exchange directions are first sought, without a rejected step of its
# own, what still falls is fine structure, and LATE_REMAINDER is enough, of a series of falls over
# windows of twice as many iterations: changes of nine giants' and pairs' fluxes stay below 0.06
# errors, in three quarters of the iterations (bench.ladder, seeds 505 and 6161). With 4 they take
# two thirds, but a fit of HST and HSC ends on a plateau, from which one flux moves by 0.9 errors.
CONVERGENCE_WINDOW, MAX_REMAINDER, MIN_FALL = 5, 0.1, 0.01
LATE_ROUNDS, LATE_REMAINDER = 2 * CONVERGENCE_WINDOW, 1.0
# Number of parameters that the data determine from which the tolerance of a source alone grows in
# proportion, and the largest factor. With no neighbour and no sky level to exchange light with,
# what still falls is spread over all of these parameters. Two galaxies of n = 4 and signal to noise
# 19,000 and 28,000 that ended at the limit of 500 iterations converge after 417 and 385; one of r_e
# 48 px still ends there. Fluxes, sizes and ellipticities of five such galaxies change by at most
# 0.007 errors (bench.ladder, single, seed 77001). Of six sources of 5 px with bright clumps four
# end at the limit. In 100 to 1000 further iterations fluxes change by at most 0.002 errors, sizes
# and ellipticities by 0.1, one centroid by 0.3. Without a largest factor all six converge, but one
# size is 0.4 and one ellipticity 0.5 errors off.
TOL_PARAMETERS, MAX_TOL_FACTOR = 25.0, 4.0


class LbfgsControl:
    """Arrays over the scenes of a batch (B,).

    loss_tol: see Settings; n_pixels (B,): observed, with a weight

    live: unfinished scenes; converged, failed: finished ones
    failed: scenes whose loss at their current point is not finite
    loss: of the last accepted trial; n_iterations: accepted trials, the start not counted
    n_rounds: of each scene, trials so far
    settled: scenes with settled strengths; tested: scenes tested for significant structure
    n_determined: parameters that the data determine, of scenes of one source alone; 0 of others
    """

    def __init__(self, n_scenes, loss_tol, n_pixels):
        n, self.loss_tol, self._n_pixels = n_scenes, loss_tol, np.asarray(n_pixels, float)
        self.live, self.converged, self.failed = (
            np.ones(n, bool),
            np.zeros(n, bool),
            np.zeros(n, bool),
        )
        self.loss = np.full(n, np.inf)
        self.n_iterations, self.n_rounds = np.zeros(n, int), np.zeros(n, int)
        self.settled, self.tested = np.zeros(n, bool), np.zeros(n, bool)
        self.n_determined = np.zeros(n)
        self._due = np.full(n, FIRST_STRENGTH_ROUND)
        self._fresh = np.ones(n, bool)  # the trial is at the present point, with a changed loss
        self._bare = np.zeros(n, bool)  # pairs were dropped after a direction without descent
        self._length, self._trials = np.ones(n), np.zeros(n, int)
        self._refused = np.zeros(n, int)  # the round of the last rejected trial of its own
        self._external = np.zeros(n, bool)  # the trial is along an external step
        # the last losses, the present one first; NaN before the first one
        self._losses = np.full((n, 4 * CONVERGENCE_WINDOW + 1), np.nan)

    def take(self, keep):
        """The LbfgsControl of the scenes `keep` (n,) alone."""
        new = LbfgsControl(len(keep), self.loss_tol, self._n_pixels[keep])
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(new, name, value[keep])
        return new

    def accept_trials(self, loss, slope):
        """Accepts or rejects each scene's trial (B,), and selects steps that give a pair (B,).

        slope (B,): g . (x_new - x)
        """
        self.n_rounds += self.live
        finite, fresh = np.isfinite(loss), self._fresh
        self.failed |= self.live & fresh & ~finite
        self.live &= ~self.failed
        with np.errstate(invalid="ignore"):
            lower = (slope < 0) & (loss <= self.loss + ARMIJO * slope)
            shrink = -slope / (2 * np.maximum(loss - self.loss - slope, 1e-30))
        self._shrink = np.where(np.isfinite(shrink), shrink, 0).clip(*SHRINK)
        self._uphill = ~(slope < 0)
        accepted = self.live & finite & (lower | fresh)
        stepped = accepted & ~fresh
        self._losses[stepped, 1:] = self._losses[stepped, :-1]
        self.n_iterations += stepped
        self._losses[accepted, 0] = self.loss[accepted] = loss[accepted]
        self._fresh &= ~accepted
        return accepted, stepped

    def exchanges_due(self):
        """Selects scenes (B,) whose ExchangeDirections are found now."""
        n, rest = np.divmod(self.n_rounds, FIRST_EXCHANGE_ROUND)
        return self.live & (rest == 0) & (n > 0) & (n & (n - 1) == 0)

    def strengths_due(self, accepted):
        """Selects scenes (B,) whose strengths are updated now."""
        calm = self._fallen(LOSS_WINDOW) < STRENGTH_LOSS_DROP * self.chi2()
        late, common = self.n_rounds >= self._due, self.n_rounds % COMMON_ROUNDS == 0
        return accepted & ~self.settled & ((common & (calm | late)) | (self._due == 0))

    def significance_due(self, accepted):
        """Selects scenes (B,) to be tested now for significant structure."""
        fall, chi2 = self._fallen(LOSS_WINDOW), self.chi2()
        calm = fall < max(SIGNIFICANCE_LOSS_DROP, 2 * self.loss_tol) * chi2
        far = (self.n_rounds >= LATE_LOOK) & (fall > FALLING * chi2)
        misfit = self.loss > MAX_LOSS * self._n_pixels
        return accepted & self.settled & ~self.tested & (calm | far | misfit)

    def record_significance(self, which, clear):
        """Records that the scenes `which` (B,) were tested for significant structure.

        Scenes with `clear` (B,) true have new significant structure: they update strengths again,
        and are then tested again.
        """
        self.tested |= which & ~clear
        self.settled &= ~clear
        return clear

    def record_strengths(self, due, moved, change):
        """Records the strength updates of the scenes `due`.

        moved (B,): largest change of a logarithm of a strength; change (B,): of their losses.
        """
        self.loss += np.where(due, change, 0)
        self.settled |= due & (moved < MAX_LOG_STRENGTH_CHANGE)
        self._due[due] = self.n_rounds[due] + STRENGTH_ROUNDS
        self._losses[due, 0], self._losses[due, 1:] = self.loss[due], np.nan

    def refresh_loss(self, which):
        """Marks the losses of scenes `which` (B,) as changed.

        Their next trial is at the present point.
        """
        self._fresh |= which
        self._bare &= ~which
        self._losses[which, 1:] = np.nan
        self._call_back(which)

    def resume(self, which):
        """Prepares the scenes `which` (B,), converged or not, for a trial of an external step.

        A scene that had converged does so again at once, unless the step lowers its loss.
        """
        self._call_back(which)
        self._external |= which
        self._length[which], self._trials[which] = 1.0, 0

    def _call_back(self, which):
        """Continues the scenes `which` (B,), even if they had converged."""
        self.converged &= ~which
        self.live |= which

    def next_actions(self, accepted):
        """Mode (B,) and length (B,) of each scene's next step, and which drop their pairs (B,)."""
        enough = self.loss_tol * self._tol_factor() * self.chi2()
        late = self.n_rounds - np.maximum(self._refused, FIRST_EXCHANGE_ROUND) >= LATE_ROUNDS
        calm = self._slows(CONVERGENCE_WINDOW, enough, MAX_REMAINDER * enough)
        calm |= late & self._slows(2 * CONVERGENCE_WINDOW, 2 * enough, LATE_REMAINDER * enough)
        calm |= self._fallen(CONVERGENCE_WINDOW) < MIN_FALL * enough
        # others have looked for significant structure before they are as calm as `loss_tol` asks
        looked = self.tested | (self.n_determined == 0)
        self.converged |= accepted & self.settled & calm & looked
        self.live &= ~self.converged
        refused = self.live & ~accepted
        own = refused & ~self._external
        self._refused[own] = self.n_rounds[own]
        self._trials = np.where(refused, self._trials + 1, 0)
        self._length = np.where(refused, self._length * self._shrink, 1.0)
        lost = refused & (self._uphill | (self._trials >= MAX_TRIALS))
        bare, stuck = lost & ~self._bare, lost & self._bare
        self._external &= refused & ~bare
        self._length[bare], self._trials[bare] = 1.0, 0
        self._bare = (self._bare & ~accepted) | bare
        # No step lowers the loss any more, because of its rounding errors. Strengths are updated
        # from here, or the fit has converged.
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

    def _slows(self, n, most, remainder):
        """Selects scenes (B,) whose loss fell by less than `most` (B,) over n iterations.

        With the n before as a geometric series it falls by less than `remainder` (B,) later.
        """
        fall, both = self._fallen(n), self._fallen(2 * n)
        return (fall < most) & (fall**2 < remainder * (both - 2 * fall))

    def _fallen(self, n):
        """Decrease of the losses (B,) over the last n iterations, NaN where there were fewer."""
        return self._losses[:, n] - self._losses[:, 0]

    def _tol_factor(self):
        """Factor (B,) of the tolerance, above 1 for sources alone; see TOL_PARAMETERS."""
        return np.clip(self.n_determined / TOL_PARAMETERS, 1, MAX_TOL_FACTOR)

    def chi2(self):
        """chi2 per pixel (B,), at least 1."""
        return np.maximum(1, 2 * self.loss / self._n_pixels)
