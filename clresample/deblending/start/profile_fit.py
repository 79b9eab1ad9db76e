"""Levenberg-Marquardt on the shapes of all scenes of a group, each at its own pace."""

from __future__ import annotations

import numpy as np

from ..spectra import MODEL_ERROR
from .component_batch import peaks_of, renumbered
from .equations import N_PARAMETERS, normal_equations
from .first_profiles import first_profiles
from .linearised_scenes import LinearisedScenes
from .population import PopulationPrior, contamination_factors

# Longest step of a parameter: far from the minimum the quadratic model of chi2 promises too much.
LONGEST_STEP = 0.7
# Most steps, and the chi2 that ends them when one of them gains no more than it.
N_STEPS, CHI2_TOL = 40, 1.0
# Most steps of large galaxies' profiles after each that is found, before all are fitted together.
N_FIRST_STEPS = 5
# Levenberg-Marquardt: damping of the first step as a part of the normal matrix's diagonal, what it
# is divided by after a step that gains, multiplied by after one that does not, and where it ends.
FIRST_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE, MAX_DAMPING = 1e-2, 3, 10, 1e3


class ProfileFit:
    """The least-squares problems of B scenes' parameters theta (B, n, 4), padded with zeros.

    looking: LinearisedScenes; noise (B, C): of a model pixel

    population: what is expected of the parameters
    source (B, n): to which each component belongs, -1 where there is none
    theta, chi2 (B,): of the last steps that gained; looking.spectra, looking.sky: theirs
    brightness (N,): of the components, see `thresholds`
    large (B,): scenes with galaxies found larger than expected
    """

    def __init__(self, looking: LinearisedScenes, noise):
        self.looking, self.noise = looking, noise
        shapes = [c.shape for c in looking.components]
        self.counts = np.array([len(shape.mean) for shape in shapes])
        self.at = looking.scene, looking.index
        size = looking.n_scenes, looking.n_most, N_PARAMETERS
        self.population = PopulationPrior(shapes, *self.at, *size)
        self.source = np.full(size[:2], -1)
        self.source[self.at] = [c.source for c in looking.components]
        self.theta, self.chi2 = self.population.mean.copy(), np.full(size[0], np.inf)
        self.brightness, self.large = np.zeros(len(shapes)), np.zeros(size[0], bool)
        self.right = np.zeros((size[0], size[1] * size[2]))
        self.normal = np.zeros((*self.right.shape, self.right.shape[1]))

    def thetas(self, theta=None):
        """Parameters (n,) of each component."""
        theta = self.theta if theta is None else theta
        return [t[:n] for t, n in zip(theta[self.at], self.counts, strict=True)]

    def begin(self):
        """Solves at the mean, and fits the profiles of larger galaxies, one after another."""
        looking, scenes = self.looking, np.arange(len(self.theta))
        self._look(scenes, self.theta, slopes=False)
        looking.solve(MODEL_ERROR)
        self.large[looking.scene[first_profiles(self, MODEL_ERROR)]] = True
        self._take(np.arange(len(self.theta)))

    def run(self):
        """Step until all scenes have ended."""
        some = [(self.counts[self.looking.scene == b] > 0).any() for b in range(len(self.theta))]
        self._step(np.flatnonzero(some), np.ones(self.source.shape, bool), N_STEPS, learn=True)
        self._look_again(
            np.flatnonzero(self.large & (self.population.contamination > 1).any(axis=1))
        )

    def _look_again(self, scenes):
        """Fits some scenes once more without doubt of their shapes, and keeps what is better.

        Better is a lower chi2 with the priors, doubted as it is there: where one of two alike has
        taken the other one's light, this one's shape is doubted only because it has.
        """
        if not len(scenes):
            return
        looking, doubt = self.looking, self.population.contamination
        before = self.theta.copy(), self.chi2.copy(), doubt.copy(), looking.sky.copy()
        spectra = looking.spectra.copy()
        self._take(scenes, doubt=False)
        self._step(scenes, np.ones(self.source.shape, bool), N_STEPS)
        self._take(scenes)
        worse = scenes[~(self.chi2[scenes] < before[1][scenes])]
        for now, old in zip((self.theta, self.chi2, doubt, looking.sky), before, strict=True):
            now[worse] = old[worse]
        back = np.isin(looking.scene, worse)
        looking.spectra[back] = spectra[back]
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
        """Solves some scenes at their present parameters and stores the inputs of a step.

        doubt: of shapes beside other sources, or none of them
        """
        if len(scenes):
            self._measure_brightness(self.theta)
            self._look(scenes, self.theta, slopes=True)
            self.looking.solve(MODEL_ERROR)
            if doubt:
                self._doubt(scenes)
            else:
                self.population.contamination[scenes] = 1
            self.chi2[scenes] = self._chi2(scenes, self.theta)
            self._take_equations(scenes)

    def _step(self, scenes, free, n_steps, *, learn=False):
        """Step until some scenes have ended; free (B, n): the components that move."""
        live = np.isin(np.arange(len(self.theta)), scenes)
        damping = np.full(len(live), FIRST_DAMPING)
        for i_step in range(n_steps):
            scenes = np.flatnonzero(live)
            if not len(scenes):
                return
            gain, trial = self._try(scenes, damping[scenes], free[scenes])
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

    def _try(self, scenes, damping, free):
        """Tries a step of each of the scenes.

        Returns the gain (k,), spectra of the better state, and theta (B, n, 4) after it.
        """
        looking, own = self.looking, np.eye(self.right.shape[1])
        moves = np.repeat(free, N_PARAMETERS, axis=1)
        normal = self.normal[scenes] * (moves[:, None] & moves[..., None])
        diagonal = np.diagonal(normal, axis1=1, axis2=2) * damping[:, None] + ~moves
        matrix = normal + diagonal[..., None] * own
        step = np.linalg.solve(matrix, (self.right[scenes] * moves)[..., None])
        trial, before = self.theta.copy(), (looking.spectra.copy(), looking.sky.copy())
        trial[scenes] += np.clip(step, -LONGEST_STEP, LONGEST_STEP).reshape(trial[scenes].shape)
        self._look(scenes, trial, slopes=False)
        looking.solve(MODEL_ERROR)
        new = self._chi2(scenes, trial)
        gain = self.chi2[scenes] - new
        worse = scenes[~(gain > 0)]
        back = np.isin(looking.scene, worse)
        looking.spectra[back], looking.sky[worse] = before[0][back], before[1][worse]
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
        self.population.set_contamination(
            scenes, contamination_factors(normal, spectra, self.source[scenes])
        )

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
