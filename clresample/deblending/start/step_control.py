"""Steps of Levenberg-Marquardt of several scenes, each with its own damping and length."""

from __future__ import annotations

import numpy as np

from ..linear.equations import N_PARAMETERS
from ..linear.spectra import solve_in_place

# Damping of the first step relative to the normal matrix's diagonal, its divisor after a step with
# the promised gain, its factor after a rejected one, and its largest value.
FIRST_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE, MAX_DAMPING = 0.1, 3, 10, 1e3
# A step has the promised gain if it has this fraction of it; after others the damping grows by
# DAMPING_DECREASE. Of 48 simulated scenes (seeds from 0 and 100) the start takes 244 trials, with
# steps of ln beta and without these rules 383, to the same chi2 within 6.
PROMISED = 0.5
# Longest step of a parameter: the quadratic model of chi2 is not valid far from the minimum. After
# a rejected step it is a quarter of that step, after others twice as long as before, up to this.
# Longer ones are clipped or shortened as a whole, whichever promises more: clipped alone, those of
# wide galaxies of n = 4, whose size and wings go together, promise losses, and a pair ends after 27
# steps 150 in chi2 above where it is now after 12 (bench.ladder, pair, seed 1212).
MAX_STEP = 1.0
# Largest fraction by which a step lowers ln(1 + 1 / beta), which is 0 for a Gaussian.
MAX_WINGS_FALL = 0.9


class StepControl:
    """Damping and longest steps (B,) of the scenes of a group."""

    def __init__(self, n_scenes):
        self.damping = np.full(n_scenes, FIRST_DAMPING)
        self.longest = np.full(n_scenes, MAX_STEP)
        self._length = np.zeros(n_scenes)

    def next(self, scenes, normal, prior, right, theta, galaxies, free=None):
        """Parameters (k, n, 4) of the next trial of some scenes.

        Also the gains (k,) in chi2 that are expected of whole steps and of those that are taken.

        normal (k): arrays (P, P), prior (k, P): added to their diagonals, right (k, P), theta
            (k, n, 4): their equations and parameters; galaxies (k, n): those with wings; free
            (k, n): the components that move, None for all
        """
        scale, per_scale = wings_scale(theta)
        most = np.full(theta.shape, np.inf)
        most[..., 3] = np.where(galaxies, MAX_WINGS_FALL * scale * per_scale, np.inf)
        most, moves = most.reshape(right.shape), np.ones(right.shape, bool)
        if free is not None:
            moves = np.repeat(free, N_PARAMETERS, axis=1)
        given = normal, prior, right, self.damping[scenes], moves, most
        whole = np.array([_bounded(*own) for own in zip(*given, strict=True)]).reshape(theta.shape)
        longest = self.longest[scenes, None, None]
        part = longest / np.maximum(np.abs(whole).max(axis=(1, 2), keepdims=True), longest)
        clipped, scaled = np.clip(whole, -longest, longest), part * whole
        steps = (s.reshape(right.shape) for s in (whole, clipped, scaled))
        expected, *promised = (_gain(normal, prior, right, s) for s in steps)
        step = np.where((promised[0] >= promised[1])[:, None, None], clipped, scaled)
        self._length[scenes] = np.abs(step).max(axis=(1, 2))
        trial = theta + step
        wings = -np.log(np.expm1(scale - step[..., 3] / per_scale))
        trial[..., 3] = np.where(galaxies, wings, trial[..., 3])
        return trial, expected, np.maximum(*promised)

    def take(self, scenes, gain, promised):
        """Adapts to the gains (k,) of a trial; selects the scenes (k,) that may have another."""
        as_promised = gain > PROMISED * promised
        factor = np.where(as_promised, 1 / DAMPING_DECREASE, DAMPING_DECREASE)
        factor = np.where(gain > 0, factor, DAMPING_INCREASE)
        self.damping[scenes] *= factor
        shorter = self._length[scenes] / 4
        longer = np.minimum(2 * self.longest[scenes], MAX_STEP)
        self.longest[scenes] = np.where(gain > 0, longer, shorter)
        return self.damping[scenes] <= MAX_DAMPING


def _bounded(normal, prior, right, damping, moves, most):
    """Damped step (P,) of those that move (P,), with those beyond `most` (P,) held there.

    normal (P, P), prior (P,), right (P,), damping: of one scene
    """
    held, diagonal = np.zeros_like(right), (np.diagonal(normal) + prior) * (1 + damping)
    for _ in range(2):
        matrix = normal * (moves & moves[:, None])
        np.einsum("ii->i", matrix)[:] = np.where(moves, diagonal, 1)
        away = (right - normal @ held - prior * held) * moves
        step = solve_in_place(matrix, away) + held
        beyond = step > most
        if not beyond.any():
            break
        held, moves = np.where(beyond, most, held), moves & ~beyond
    return np.minimum(step, most)


def wings_scale(theta):
    """ln(1 + 1 / beta) (k, n) of parameters (k, n, 4), and the fall of ln beta by 1 of it.

    Profiles are nearly linear in it: it is 1 / beta near a Gaussian, -ln beta of wide wings.
    """
    beta = np.exp(theta[..., 3])
    return np.log1p(1 / beta), 1 + beta


def _gain(normal, prior, right, step):
    """Fall (k,) of chi2 by steps (k, P), to second order, from equations as of StepControl."""
    curvature = [s @ (own @ s) for own, s in zip(normal, step, strict=True)]
    return 2 * (step * right).sum(axis=1) - (prior * step**2).sum(axis=1) - curvature
