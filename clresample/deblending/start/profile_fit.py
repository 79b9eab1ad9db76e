"""Levenberg-Marquardt on the shapes of all scenes of a group, each at its own pace."""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from ..spectra import MODEL_ERROR
from .component_batch import peaks_of, renumbered
from .equations import N_PARAMETERS, normal_equations
from .first_profiles import first_profiles
from .linearised_scenes import LinearisedScenes
from .population import OWN_LIGHT, PopulationPrior, contamination_factors
from .shape_grid import fit_faint_shapes

# Longest step of a parameter: the quadratic model of chi2 is not valid far from the minimum.
LONGEST_STEP = 0.7
# Largest number of steps, and the gain in chi2 below which they end, measured or expected.
N_STEPS, CHI2_TOL = 40, 1.0
# Largest number of steps after each large profile that is added, before all are fitted together.
N_FIRST_STEPS = 5
# A scene is started again, from profiles of large galaxies, if a galaxy became larger than expected
# by this in ln sigma, or if chi2 per pixel is above MAX_CHI2. Of 24 simulated scenes (seeds from 0)
# none of parametric galaxies is beyond 0.74 and 1.06, but six of real COSMOS galaxies are, and the
# start of all takes 1.7 times as long. Second starts that differed from first ones were all of
# scenes beyond 1.1 (bench.ladder, seed 5).
MAX_GROWTH, MAX_CHI2 = 0.8, 1.2
# Levenberg-Marquardt: damping of the first step relative to the normal matrix's diagonal, its
# divisor after a successful step, its factor after a rejected one, and its largest value.
FIRST_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE, MAX_DAMPING = 1e-2, 3, 10, 1e3


class ProfileFit:
    """The least-squares problems of B scenes' parameters theta (B, n, 4), padded with zeros.

    looking: LinearisedScenes; noise (B, C): of a model pixel

    expected, population: PopulationPriors on the parameters, the first and the present one
    source (B, n): to which each component belongs, -1 where there is none
    theta, chi2 (B,): of the last steps that gained; looking.spectra, looking.sky: theirs
    brightness (N,): of the components, see `thresholds`
    flux_scatter (N, C): of the spectra of faint galaxies, see shape_grid.py; 0 for others
    """

    def __init__(self, looking: LinearisedScenes, noise):
        self.looking, self.noise = looking, noise
        shapes = [c.shape for c in looking.components]
        self.counts = np.array([len(shape.mean) for shape in shapes])
        self.at = looking.scene, looking.index
        size = looking.n_scenes, looking.n_most, N_PARAMETERS
        self.expected = PopulationPrior(shapes, *self.at, *size)
        self.population = deepcopy(self.expected)
        self.source = np.full(size[:2], -1)
        self.source[self.at] = [c.source for c in looking.components]
        self.theta, self.chi2 = self.population.mean.copy(), np.full(size[0], np.inf)
        self.brightness, self.flux_scatter = np.zeros(len(shapes)), np.zeros_like(looking.spectra)
        self.right = np.zeros((size[0], size[1] * size[2]))
        self.normal = np.zeros((*self.right.shape, self.right.shape[1]))

    def thetas(self, theta=None):
        """Parameters (n,) of each component."""
        theta = self.theta if theta is None else theta
        return [t[:n] for t, n in zip(theta[self.at], self.counts, strict=True)]

    def begin(self):
        """Solves at the mean."""
        self._take(np.arange(len(self.theta)))
        self._measure_brightness(self.theta)  # now with spectra

    def run(self):
        """Steps until all scenes have ended; starts those with large galaxies in two ways."""
        some = [(self.counts[self.looking.scene == b] > 0).any() for b in range(len(self.theta))]
        self._step(np.flatnonzero(some), learn=True)
        scenes = self._with_large_galaxies()
        if len(scenes):
            self._run_from_large_galaxies(scenes)
            doubted = (self.population.contamination[scenes] > 1).any(axis=1)
            self._run_without_doubt(scenes[doubted])
        fit_faint_shapes(self, np.flatnonzero(some))

    def _with_large_galaxies(self):
        """Selects the scenes (k,) that may hold large galaxies, or whose data are unexplained."""
        growth = (self.theta - self.expected.mean)[..., 0] * self.expected.galaxies
        unexplained = self.chi2 > MAX_CHI2 * self.looking.n_pixels()
        return np.flatnonzero((growth.max(axis=1) > MAX_GROWTH) | unexplained)

    def _run_from_large_galaxies(self, scenes):
        """Fits some scenes again from profiles of large galaxies; the better fit of each stays."""
        before, chi2 = self._copy(), self._chi2_as_expected(scenes)
        self.theta[scenes] = self.expected.mean[scenes]
        self.population.reset(scenes, self.expected)
        self.population.own_light[scenes] = OWN_LIGHT
        self._look(scenes, self.theta, slopes=False)
        self.looking.solve(MODEL_ERROR)
        first_profiles(self, scenes, MODEL_ERROR)
        self._take(scenes)
        self._step(scenes, learn=True)
        self._restore(before, scenes[chi2 <= self._chi2_as_expected(scenes)])

    def _chi2_as_expected(self, scenes):
        """Chi2 (k,) with the priors as they were before any scene was fitted."""
        learned = self.population.penalty(scenes, self.theta)
        return self.chi2[scenes] - learned + self.expected.penalty(scenes, self.theta)

    def _run_without_doubt(self, scenes):
        """Fits some scenes again without contamination of their shapes; the better fit stays.

        If one of two similar galaxies has the other one's light, that one's shape is contaminated.
        """
        if len(scenes):
            before = self._copy()
            self._take(scenes, doubt=False)
            self._step(scenes)
            self._take(scenes)
            self._restore(before, scenes[before[0][scenes] <= self.chi2[scenes]])

    def _copy(self):
        """Copies of chi2, theta, the solution and the prior."""
        kept = self.looking.kept_solution(), deepcopy(self.population)
        return self.chi2.copy(), self.theta.copy(), *kept

    def _restore(self, before, scenes):
        """Restores some scenes (k,) from a `_copy`."""
        chi2, theta, solution, population = before
        self.chi2[scenes], self.theta[scenes] = chi2[scenes], theta[scenes]
        self.looking.restore(solution, scenes)
        self.population.reset(scenes, population)
        self._measure_brightness(self.theta)

    def fit_part(self, thetas, free, scenes):
        """Fits profiles of some components without the others; their parameters, as `thetas`.

        thetas: {component: parameters (n,)}; free: set of those that move; scenes (k,): that are
            fitted, others stay as they are
        """
        here = [i for i in thetas if self.looking.scene[i] in scenes]
        part = self.looking.with_components(renumbered(self.looking.components[i] for i in here))
        fit = ProfileFit(part, self.noise)
        moves = np.zeros(fit.source.shape, bool)
        for b, k, i in zip(*fit.at, here, strict=True):
            fit.theta[b, k, : len(thetas[i])] = thetas[i]
            moves[b, k] = i in free
        fit._take(scenes)
        fit._step(scenes, moves, N_FIRST_STEPS)
        return thetas | dict(zip(here, fit.thetas(), strict=True))

    def _take(self, scenes, *, doubt=True):
        """Solves some scenes for a step; doubt: contaminate blended shapes; None = as before."""
        if len(scenes):
            self._measure_brightness(self.theta)
            self._look(scenes, self.theta, slopes=True)
            self.looking.solve(MODEL_ERROR)
            if doubt:
                self._doubt(scenes)
            elif doubt is not None:
                self.population.contamination[scenes] = 1
            self.chi2[scenes] = self._chi2(scenes, self.theta)
            self._take_equations(scenes)

    def _step(self, scenes, free=None, n_steps=N_STEPS, *, learn=False):
        """Step until some scenes have ended; free (B, n): the components that move."""
        live = np.isin(np.arange(len(self.theta)), scenes)
        damping = np.full(len(live), FIRST_DAMPING)
        free = np.ones(self.source.shape, bool) if free is None else free
        for i_step in range(n_steps):
            scenes = np.flatnonzero(live)
            step, expected = self._next_step(scenes, damping[scenes], free[scenes])
            scenes, step = scenes[expected >= CHI2_TOL], step[expected >= CHI2_TOL]
            live = np.isin(np.arange(len(live)), scenes)
            if not len(scenes):
                return
            gain, trial = self._try(scenes, step)
            gained = gain > 0
            damping[scenes] = np.where(
                gained, damping[scenes] / DAMPING_DECREASE, damping[scenes] * DAMPING_INCREASE
            )
            enough = gained & (gain < CHI2_TOL)
            live[scenes] = ~enough & (damping[scenes] <= MAX_DAMPING)
            self.theta[scenes[gained]] = trial[scenes[gained]]
            self._measure_brightness(self.theta)
            further = scenes[gained & live[scenes]]
            if len(further) and i_step < n_steps - 1:
                if learn:
                    self._learn(further)
                self._look(further, self.theta, slopes=True)
                self.looking.compute_residuals(MODEL_ERROR)
                self._take_equations(further)

    def _next_step(self, scenes, damping, free):
        """Steps (k, n, 4) of some scenes, and the gain (k,) in chi2 expected of longer ones."""
        own, moves = np.eye(self.right.shape[1]), np.repeat(free, N_PARAMETERS, axis=1)
        normal = self.normal[scenes] * (moves[:, None] & moves[..., None])
        right = self.right[scenes] * moves
        diagonal = np.diagonal(normal, axis1=1, axis2=2) * damping[:, None] + ~moves
        step = np.linalg.solve(normal + diagonal[..., None] * own, right[..., None])
        expected = (step * (2 * right[..., None] - normal @ step)).sum(axis=(1, 2))
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        return step.reshape(len(scenes), *self.theta.shape[1:]), expected

    def _try(self, scenes, step):
        """Tries a step (k, n, 4) of each of the scenes.

        Returns the gain (k,), spectra of the better state, and theta (B, n, 4) after it.
        """
        trial, before = self.theta.copy(), self.looking.kept_solution()
        trial[scenes] += step
        self._look(scenes, trial, slopes=False)
        self.looking.solve(MODEL_ERROR)
        new = self._chi2(scenes, trial)
        gain = self.chi2[scenes] - new
        self.looking.restore(before, scenes[~(gain > 0)])
        self.chi2[scenes] = np.where(gain > 0, new, self.chi2[scenes])
        return gain, trial

    def _look(self, scenes, theta, *, slopes):
        self.looking.render(scenes, self.thetas(theta), self.brightness, slopes=slopes)

    def _chi2(self, scenes, theta):
        """With the priors (k,)."""
        return self.looking.compute_residuals(MODEL_ERROR) + self.population.penalty(scenes, theta)

    def _learn(self, scenes):
        """Updates the prior of some scenes from the present parameters."""
        before = self.population.penalty(scenes, self.theta)
        self.population.update(scenes, self.theta, self.normal)
        self._doubt(scenes)
        self.chi2[scenes] += self.population.penalty(scenes, self.theta) - before

    def _doubt(self, scenes):
        """Stores the shape errors caused by neighbours, for some of the scenes solved last."""
        looking = self.looking
        rows = looking.rows_of(scenes)
        normal, spectra = looking.normal[rows][..., :-1, :-1], looking.solution()[rows][..., :-1]
        given = normal, spectra, self.source[scenes], self.population.own_light[scenes]
        self.population.set_contamination(scenes, contamination_factors(*given))

    def _take_equations(self, scenes):
        """Stores the normal equations of some scenes, priors included."""
        normal, right = normal_equations(self.looking)
        weight = self.population.precision(scenes, self.theta).reshape(right.shape)
        away = self.population.mean[scenes] - self.theta[scenes]
        self.normal[scenes] = normal + weight[..., None] * np.eye(right.shape[1])
        self.right[scenes] = right + weight * away.reshape(right.shape)

    def _measure_brightness(self, theta):
        """Stores the components' peaks over a model pixel's noise, in their best channel."""
        looking = self.looking
        best = (looking.spectra / self.noise[looking.scene]).max(axis=1)
        self.brightness = best * peaks_of(looking.components, self.thetas(theta))
