"""Runs a batch of scenes under the prior that learns: rounds of trials, strengths, stops.

    L = 1/2 sum_o |sqrt(w_o) (R_o M + sky - d_o)|^2 + 1/2 sum_sj |z_sj|^2 / alpha_sj^2

A round costs one pair of operators for the whole batch. Each scene then does what its own loss
asks for: it accepts its trial and takes a new direction, or goes back and takes a shorter step. The
host decides, from sums of float32 rows and chunks added in float64.
"""

from __future__ import annotations

import numpy as np

from ..buffers import Buffers
from ..gradient import Gradient
from ..scene import State
from .pairs import Pairs
from .strengths import Strengths
from .structure import Structure
from .vectors import AGAIN, NEXT, REST, STAY, TRY, Vectors

# Pairs of changes that a scene remembers: 10 take 10 to 20 % more iterations, 40 hardly fewer.
N_PAIRS = 20
# A trial is accepted if the loss falls by this part of what the slope promises.
ARMIJO = 1e-4
# Shortest and longest next step after a trial that was not accepted, as parts of it; trials before
# the memory is dropped, and after that before a scene is left where it is.
SHRINK = 0.1, 0.5
TRIALS = 8
# Strengths are learned after so many rounds, earlier ones being still far from their structure, and
# then every so many, until none of a scene's moves by more than SETTLED in its logarithm.
FIRST, EVERY, SETTLED = 16, 8, 0.1
# A fit has converged when strengths have settled and its loss fell by less than ENOUGH over
# PATIENCE iterations. The loss is half chi2: an ENOUGH of 1 leaves 94 % of fluxes within 0.2 and
# 99 % within 0.5 sigma of where they would end; 0.25 takes a third more iterations.
PATIENCE, ENOUGH = 5, 1.0
UNSEEN = 1e-14  # part of the largest power under which a channel holds nothing of a source


class LearnedEngine:
    """A batch of scenes of one signature on the device, under a LearnedPrior.

    scenes, states: of the scenes at their start: structure begins at 0, on the profiles
    loss (B,): of the last accepted trial; converged, failed (B,): of scenes that have come to their
        end; failed: the loss at the start is no number
    n_rounds: so far; n_iterations (B,): accepted trials
    """

    def __init__(self, scenes, states, device, dtype, prior):
        self.scenes, self.device = scenes, device
        b = self.buffers = Buffers(scenes, states, device, dtype, prior)
        self._gradient = Gradient(b, with_prior=False)
        self.structure = Structure(b, prior)
        self.vectors = Vectors(b, self.structure.latents, N_PAIRS + 1)
        self.pairs = Pairs(len(scenes), N_PAIRS)
        spectra = np.concatenate([s.spectra for s in states])
        self.vectors.start(spectra, np.array([s.sky for s in states]), _inverse_curvature(scenes))
        self.strengths = Strengths(b, self._gradient, self.structure.latents, prior)
        self.vectors.reweigh(self.strengths.light, self.strengths.weights(spectra))
        self._row0 = device.put(self._gradient.rows, np.int32)
        n = len(scenes)
        self.loss = np.full(n, np.inf)
        self.converged, self.failed, self.live = np.zeros(n, bool), np.zeros(n, bool), np.ones(n, bool)
        self.n_rounds, self.n_iterations = 0, np.zeros(n, int)
        self._fresh, self._settled = np.ones(n, bool), np.zeros(n, bool)
        self._bare = np.zeros(n, bool)  # on the diagonal alone since the last accepted trial
        self._due = np.full(n, FIRST)
        self._length, self._trials = np.ones(n), np.zeros(n, int)
        self._drops = np.full((n, PATIENCE), np.inf)

    def stop(self, which):
        """Leave the scenes `which` (B,) where they are from now on."""
        self.live &= ~which

    def round(self):
        """One pair of operators: try every live scene's trial, decide, and queue the next ones.

        returns accepted (B,): scenes whose `loss` is new
        """
        v = self.vectors
        self.n_rounds += 1
        self._evaluate()
        sums, slope = v.sums()
        energies = self.device.get(self.structure.energies).astype(np.float64)
        loss = self._losses(energies)
        accepted = self._accepted(loss, slope)
        self._note(accepted, loss)
        new = np.flatnonzero(accepted & ~self._fresh)
        self.pairs.take(new, sums[new, :, 2], sums[new, :, 3])
        v.follow(self.pairs)
        self._fresh &= ~accepted
        due = accepted & ~self._settled & (self.n_rounds >= self._due)
        if due.any():
            sums = self._learn(due, energies)
        self._judge(accepted)
        self._go_on(accepted, loss, slope, sums)
        return accepted

    def states(self) -> list[State]:
        """The scenes' present states, back on the host."""
        b, v = self.buffers, self.vectors
        self.structure.form(v.x)
        v.take(v.x)
        return b.states(b.iterated, [None] * len(self.scenes), self.n_rounds)

    def follow_shifts(self):
        """Take over the shifts that the scenes' operators have by now, where the scenes are."""
        self._gradient.follow_shifts()
        self.pairs.forget(self.live)
        self._fresh, self._bare = self._fresh | self.live, self._bare & ~self.live
        self._drops[self.live] = np.inf
        nothing = np.zeros((len(self.scenes), N_PAIRS + 1))
        mode = np.where(self.live, STAY, REST)
        self.vectors.advance(mode, nothing, nothing, nothing[:, 0], nothing[:, 0])

    def _evaluate(self):
        """Queue loss, gradient and inner products at the trials."""
        v, gradient = self.vectors, self._gradient
        self.structure.form(v.x_new)
        v.take()
        gradient.queue()
        self.structure.gradient(v.x_new, self.strengths.precision, v.g_new)
        v.give(gradient.rows_pull, self._row0)
        self.structure.energy(v.x_new)
        v.set_mode(np.where(self.live, TRY, REST))
        v.change()

    def _losses(self, energies):
        """Losses (B,) at the trials."""
        rows = self.device.get(self._gradient.rows_loss).sum(1, dtype=np.float64)
        return rows + self.strengths.loss(energies)

    def _accepted(self, loss, slope):
        """Which live scenes (B,) take their trial."""
        with np.errstate(invalid="ignore"):
            lower = (slope < 0) & (loss <= self.loss + ARMIJO * slope)
        finite = np.isfinite(loss)
        self.failed |= self.live & self._fresh & ~finite
        self.live &= ~self.failed
        return self.live & finite & (lower | self._fresh)

    def _note(self, accepted, loss):
        """Take down the losses of accepted trials."""
        fallen = accepted & ~self._fresh
        self._drops[fallen] = np.roll(self._drops[fallen], 1, axis=1)
        self._drops[fallen, 0] = (self.loss - loss)[fallen]
        self.n_iterations += fallen
        self.loss[accepted] = loss[accepted]

    def _learn(self, due, energies):
        """New strengths of the scenes `due` (B,), and all that follows; other sums of `change`."""
        v = self.vectors
        spectra = self.device.get(self.buffers.spectra).astype(np.float64)
        moved, weights, change = self.strengths.learn(due, energies, spectra)
        v.set_mode(np.where(due, TRY, REST))
        v.reweigh(self.strengths.light, weights)
        sy, yy = v.gram()
        self.pairs.renew(due, sy[due], yy[due])
        v.set_mode(np.where(self.live, TRY, REST))
        v.change()  # into spare slots, which hold no pair by now
        self.loss += np.where(due, change, 0)
        self._settled |= due & (moved < SETTLED)
        self._due[due] = self.n_rounds + EVERY
        self._drops[due] = np.inf
        return v.sums()[0]

    def _judge(self, accepted):
        """Which scenes have converged."""
        self.converged |= accepted & self._settled & (self._drops.sum(1) < ENOUGH)
        self.live &= ~self.converged

    def _go_on(self, accepted, loss, slope, sums):
        """Queue the next trials: on from accepted ones, back from others."""
        refused = self.live & ~accepted
        self._trials = np.where(refused, self._trials + 1, 0)
        with np.errstate(all="ignore"):
            shrink = -slope / (2 * np.maximum(loss - self.loss - slope, 1e-30))
        shrink = np.clip(np.nan_to_num(shrink, nan=0.0), *SHRINK)
        self._length = np.where(refused, self._length * shrink, 1.0)
        lost = refused & ((slope >= 0) | (self._trials >= TRIALS))
        bare = lost & ~self._bare
        stuck = lost & self._bare
        self.pairs.forget(bare)
        self._length[bare], self._trials[bare] = 1.0, 0
        self._bare = (self._bare & ~accepted) | bare
        # No step lowers the loss: what float32 can tell has been reached, and strengths are learned
        # from here, or the fit ends.
        self.converged |= stuck & self._settled
        self.live &= ~self.converged
        stuck &= self.live
        self._due[stuck] = 0
        self._fresh |= stuck
        mode = np.full(len(accepted), REST)
        mode[refused], mode[bare], mode[stuck], mode[accepted] = TRY, AGAIN, STAY, NEXT
        a, c, scale = self.pairs.coefficients(sums[:, :, 0], sums[:, :, 1])
        self.vectors.advance(mode, a, c, scale, self._length)


def _inverse_curvature(scenes):
    """1 / (sum w (R S)^2) of every spectrum (S, C) and 1 / sum w of every sky level (B, C); 0 where
    nothing is seen, and of sky levels that are not fitted."""
    power = np.concatenate([s.power for s in scenes])
    seen = power > UNSEEN * power.max(initial=0)
    total = np.array([np.concatenate([w.sum((1, 2)) for w in s.weights]) for s in scenes])
    free = (total > 0) & np.array([s.fit_sky for s in scenes])[:, None]
    return _inverse(power, seen), _inverse(total, free)


def _inverse(values, where):
    return np.divide(1, values, where=where, out=np.zeros(values.shape))
