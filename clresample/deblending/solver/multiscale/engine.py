"""Runs a batch of scenes under the multi-scale prior: rounds of trials, strengths, stops.

    L = 1/2 sum_o |sqrt(w_o) (R_o M + sky - d_o)|^2 + 1/2 sum_c p_c sky_c^2
        + 1/2 sum_sj |z_sj|^2 / alpha_sj^2,      p: Scene.known_sky

A round costs one pair of operators for the whole batch. Each scene then accepts its trial and takes
a new direction, or rejects it and takes a shorter step, depending on its own loss. The host
decides, from sums of rows and chunks that are added in float64, because a float32 loss of 3e5 is
accurate only to 0.05, a fifth of Settings.loss_tol.
"""

from __future__ import annotations

import weakref

import numpy as np

from ....device.program import LaunchList
from ..buffers import SceneBuffers
from ..gradient import LossGradient
from ..scene import State, StructureState
from .inverse import MAX_BLOCK_SIZE
from .lbfgs_control import LbfgsControl
from .lbfgs_pairs import LbfgsPairs
from .lbfgs_steps import REST, STAY, TRY, LbfgsSteps
from .strengths import PriorStrengths
from .structure import StructureOperator, coarse_count
from .vectors import SceneGradient, SolverVectors

# Number of (s, y) pairs of a scene: with 20, fits need as many iterations; with 5, some more.
N_PAIRS = 10
# Fraction of a source's largest curvature in any channel below which a channel does not contain it.
UNSEEN = 1e-14


class MultiscaleEngine:
    """A batch of scenes of one signature on the device, under a MultiscalePrior.

    scenes, states: of the scenes at their start: at the profiles, unless states have a
        StructureState
    enough: a scene has converged when its loss fell by less than this over some iterations, see
        lbfgs_control.py
    past: another engine and the indices (n,) of its scenes that continue here as `scenes`

    progress: the scenes' LbfgsControl; strengths: their sources' PriorStrengths
    """

    def __init__(self, scenes, states, device, dtype, prior, loss_tol, *, past=None):
        self.scenes, self._states, self.device, self.prior = scenes, states, device, prior
        b = self.buffers = SceneBuffers(scenes, states, device, dtype, prior)
        before = None if past is None else past[0]._gradient
        self._gradient = LossGradient(b, before=before)
        self.structure = StructureOperator(b, prior)
        latents = self.structure.latents
        v = self.vectors = SolverVectors(b, latents, N_PAIRS + 1)
        self.steps = LbfgsSteps(v, None if past is None else past[0].steps.shelf)
        self._row0 = device.put(self._gradient.rows, np.int32)
        if past is None:
            self.progress = LbfgsControl(len(scenes), loss_tol, [_n_pixels(s) for s in scenes])
            self.pairs = LbfgsPairs(len(scenes), N_PAIRS)
            self.strengths = PriorStrengths(b, self._gradient, latents, prior, states)
            v.start(*_begins(latents, states), _inverse_curvature(scenes))
            self._rest_others(self.progress.live)
            spectra = np.concatenate([s.spectra for s in states])
            new = np.array([s.learned is None for s in states])
            if new.any():
                self.strengths.begin(new, *self._slope_powers())
            self.strengths.request_blocks(spectra, self.progress.n_rounds)
            self.steps.reweigh(self.strengths.light, self.strengths.weights(spectra))
            self._exchanges = [[] for _ in scenes]
        else:
            engine, keep = past
            self._exchanges = [engine._exchanges[i] for i in keep]
            self.progress, self.pairs = engine.progress.take(keep), engine.pairs.subset(keep)
            self.strengths = PriorStrengths(
                b, self._gradient, latents, prior, past=(engine.strengths, keep)
            )
            v.copy_from(engine.vectors, keep)
            self._rest_others(self.progress.live)
        self.steps.take_blocks(self.strengths.schedule.blocks, self._exchanges)
        own = weakref.ref(self)  # in a cycle its buffers would wait for the garbage collector
        self._trial = LaunchList(device, lambda: own()._queue_trial())

    def subset(self, keep):
        """An engine of the scenes `keep` (n,) alone, which continue unchanged."""
        return MultiscaleEngine(
            [self.scenes[i] for i in keep],
            [self._states[i] for i in keep],
            self.device,
            self.buffers.dtype,
            self.prior,
            self.progress.loss_tol,
            past=(self, keep),
        )

    def round(self):
        """One pair of operators: try every live scene's trial, decide, and queue the next ones.

        returns accepted (B,): scenes whose progress.loss is new
        """
        p = self.progress
        self._precondition()
        sums, slope, loss = self._evaluate()
        accepted, stepped = p.accept_trials(loss, slope)
        new = np.flatnonzero(stepped)
        self.pairs.take(new, sums[new, :, 2], sums[new, :, 3])
        due = p.strengths_due(accepted) | self._clear(p.significance_due(accepted))
        if due.any():
            sums = self._learn(due)
        mode, length, bare = p.next_actions(accepted)
        self.pairs.forget(bare)
        a, c, scale = self.pairs.coefficients(sums[:, :, 0], sums[:, :, 1])
        self.steps.follow(self.pairs, mode)
        self.steps.advance(a, c, scale, length)
        return accepted

    def _precondition(self):
        """Takes blocks that are made by now, and new directions of exchange where they are due."""
        blocks = self.strengths.take_blocks(self.progress.n_rounds)
        exchanging = self.progress.exchanges_due()
        if exchanging.any():
            found = self.strengths.find_exchanges(exchanging, self.states(exchanging))
            moved = [bool(now or found.get(i)) for i, now in enumerate(self._exchanges)]
            self._exchanges = [found.get(i, now) for i, now in enumerate(self._exchanges)]
            blocks = self.strengths.schedule.blocks
            self.pairs.forget(exchanging & moved)  # they are of another inverse curvature
        if blocks is not None:
            self._trial.forget()  # it holds the present blocks, which make room for the next
            self.steps.take_blocks(blocks, self._exchanges)

    def _evaluate(self):
        """Inner products, slopes and losses at the trials."""
        self._trial()
        sums, slope, energy, rows = self.steps.products(self._gradient.rows_loss)
        return sums, slope, rows.sum(1, dtype=np.float64) + 0.5 * energy

    def _queue_trial(self):
        """Queues gradients, losses and inner products at the trials."""
        self._queue_gradient()
        self.vectors.pack_gradients(self._gradient.rows_pull, self._row0)
        self.steps.queue_products()

    def _queue_gradient(self):
        """Queues losses at the trials and their gradients, those by the structure in g_new."""
        v = self.vectors
        self.structure.form(v.x_new)
        v.unpack_spectra(v.x_new)
        self._gradient.queue()
        self.structure.gradient(v.x_new, self.strengths.precision, v.g_new)

    def _slope_powers(self):
        """|dL/dz|^2 (S, J) at the trials, without structure, and the spectra (S, C) there."""
        self._queue_gradient()
        return self._energies(self.vectors.g_new)

    def _clear(self, asking):
        """Selects scenes (B,) of those `asking` (B,) that hold significant structure."""
        if not asking.any():
            return asking
        clear = self.strengths.find_significant(asking, *self._energies(self.vectors.x_new))
        return self.progress.record_significance(asking, clear)

    def _energies(self, vector):
        """|z|^2 (S, J) of a vector, and the spectra (S, C) last taken."""
        self.structure.energy(vector)
        both = self.device.get_all([self.structure.energies, self.buffers.spectra])
        return tuple(values.astype(np.float64) for values in both)

    def _learn(self, due):
        """Updates strengths, and all that depends, of the scenes `due` (B,); inner products."""
        energies, spectra = self._energies(self.vectors.x_new)
        moved, weights, change = self.strengths.learn(due, energies, spectra)
        self.strengths.request_blocks(spectra, self.progress.n_rounds, due)
        self._rest_others(self.progress.live)
        self.steps.reweigh(self.strengths.light, weights)
        self.progress.record_strengths(due, moved, change)
        settled = due & self.progress.settled & [_is_alone(s) for s in self.scenes]
        for i, found in enumerate(self.strengths.findings(settled, energies, spectra)):
            if found is not None:
                self.progress.n_determined[i] = found.n_effective.sum()
        self.steps.queue_products()  # their s and y go into spare slots
        return self.steps.products()[0]

    def _rest_others(self, live):
        """Restricts the launches that follow to the scenes `live` (B,)."""
        self.steps.follow(self.pairs, np.where(live, TRY, REST))

    def states(self, which=None) -> list[State | None]:
        """The present states of the scenes `which` (B,), None: of all; None for the others."""
        which = np.ones(len(self.scenes), bool) if which is None else which
        b, v = self.buffers, self.vectors
        self.structure.form(v.x)
        morphs, parts = b.morphologies(which), v.split(v.x, which)
        known = self.strengths.by_scene()
        found: list[State | None] = [None] * len(which)
        for i in np.flatnonzero(which).tolist():
            structure, spectra, sky = parts[i]
            found[i] = State(morphs[i], spectra, sky, StructureState(structure, *known[i]))
        return found

    def findings(self, which):
        """StrengthEstimates of the scenes `which` (B,) at their present states, None for others."""
        self.vectors.unpack_spectra(self.vectors.x)
        return self.strengths.findings(which, *self._energies(self.vectors.x))

    def slopes(self, which):
        """The SceneGradient of the scenes `which` (B,) at their present states, None for others."""
        x, g = (self.vectors.split(v, which) for v in (self.vectors.x, self.vectors.g))
        return [
            SceneGradient(*slopes, (now[1] <= 0) & (slopes[1] > 0)) if on else None
            for now, slopes, on in zip(x, g, which, strict=True)
        ]

    def step(self, steps):
        """Queues trial steps of these scenes, which resume if they have converged.

        steps {scene: changes of structure, spectra and sky, see SceneGradient}; structure is None
        in scenes without any
        """
        which = np.isin(np.arange(len(self.scenes)), list(steps))
        self.vectors.put_directions(steps)
        self.progress.resume(which)
        self._queue(np.where(which, TRY, REST), 1.0)

    def update_shifts(self, moved):
        """Copies the current shifts of the operators of the scenes `moved` (B,)."""
        self._gradient.update_shifts()
        self._trial.forget()
        self.progress.refresh_loss(moved)
        self._queue(np.where(moved, STAY, REST), 0.0)

    def _queue(self, mode, length):
        """Queues trials of one length along the present directions; mode (B,)."""
        nothing = np.zeros((len(self.scenes), N_PAIRS + 1))
        self.steps.follow(self.pairs, mode)
        self.steps.advance(nothing, nothing, nothing[:, 0], nothing[:, 0] + length)
        self._rest_others(self.progress.live)


def _is_alone(scene):
    """Returns True if a scene has one source, and no sky level that takes its light."""
    return len(scene.profile) == 1 and not scene.fit_sky


def _begins(latents, states):
    """Starting vectors: coefficients, spectra (S, C), sky levels (B, C)."""
    arrays = []
    for state in states:
        arrays += state.learned.structure if state.learned else [None] * len(state.morph)
    spectra, sky = np.concatenate([s.spectra for s in states]), [s.sky for s in states]
    return latents.pack(arrays), spectra, sky


def _n_pixels(scene):
    """Observed pixels of a scene that have a weight."""
    return max(sum(np.count_nonzero(w) for w in scene.weights), 1)


def vector_bytes(scene, prior) -> int:
    """Device memory [bytes] of the scene's vectors in a batch, roughly, of float64.

    Counted are both rings of pairs, eleven other vectors and the light; and the blocks of a quarter
    of each source's coefficients: half a matrix each, half as much again as reserve, and half a
    matrix on the host.
    """
    n = [sum(coarse_count(p.shape, step).prod() for step in prior.steps) for p in scene.profile]
    blocks = 1.25 * sum(k / 4 * min(k / 4, 2 * MAX_BLOCK_SIZE) for k in n)
    return int(8 * ((2 * (N_PAIRS + 1) + 12) * (sum(n) + scene.spectrum_curvature.size) + blocks))


def _inverse_curvature(scenes):
    """Inverse curvatures of all spectra (S, C) and sky levels (B, C).

    They are 1 / (sum w (R S)^2) and 1 / (sum w + p), p the precision of the expected level; 0 for
    unobserved spectra and for levels that are not fitted.
    """
    power, ties = np.concatenate([s.spectrum_curvature for s in scenes]), scenes[0].ties
    power = power if ties is None else ties.mean(power)
    seen = power > UNSEEN * power.max(initial=0)
    total = np.array([np.concatenate([w.sum((1, 2)) for w in s.weights]) for s in scenes])
    total = total + np.array([s.known_sky for s in scenes])
    free = (total > 0) & np.array([s.fit_sky for s in scenes])[:, None]
    return _inverse(power, seen), _inverse(total, free)


def _inverse(values, where):
    return np.divide(1, values, where=where, out=np.zeros(values.shape))
