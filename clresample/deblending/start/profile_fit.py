"""Levenberg-Marquardt on the shapes of all scenes of a group, each at its own pace."""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from ..linear.component_batch import peaks_of
from ..linear.equations import N_PARAMETERS, normal_equations
from ..linear.linearised_scenes import LinearisedScenes
from ..linear.spectra import MODEL_ERROR, add_diagonal
from .close_pairs import run_from_equal_profiles
from .first_profiles import begin_with_large_galaxies
from .population import PopulationPrior, contamination_factors
from .shape_grid import fit_faint_shapes
from .step_control import StepControl
from .without_doubt import run_without_doubt

# Largest number of steps, and the gain in chi2 below which they end, measured or expected.
N_STEPS, CHI2_TOL = 40, 1.0
# A measured gain ends them only if its step had promised less than this many tolerances: others
# were too long, and shorter ones follow, 8 trials more in 206 of 24 scenes (bench.throughput). A
# pair ended 18 in chi2 early, and moved by 0.3 sigma with a faint source far away.
MAX_SHORTFALL = 2.0
# A scene may hold large galaxies if one became larger than expected by this in ln sigma, or if chi2
# per pixel is above MAX_CHI2. Of 24 simulated scenes (seeds from 0) none of parametric galaxies is
# beyond 0.74 and 1.06. Second starts that differed from first ones were all of scenes beyond 1.1
# (bench.ladder, seed 5); with 0.8 one of 300 small galaxies had all of these begin anew, in twice
# the time of their start.
MAX_GROWTH, MAX_CHI2 = 1.0, 1.2
# A first start ends, for one from large profiles, when a galaxy is larger than it began by this in
# ln sigma. That start had the lower chi2 in all of 10 scenes with several galaxies beyond 1.2
# (bench.ladder, seed 4401), at up to a fifth less time. With ln 3 more of the scenes that gain
# nothing from it are started again (bench.throughput).
GROWN = 1.5


class ProfileFit:
    """The least-squares problems of B scenes' parameters theta (B, n, 4), padded with zeros.

    looking: LinearisedScenes; noise (B, C): of a model pixel; tol: least gain in chi2 of a step

    expected, population: PopulationPriors on the parameters, the first and the present one
    source (B, n): to which each component belongs, -1 where there is none
    moves (B, n): bool, those whose parameters are fitted; others are drawn without slopes
    theta, chi2 (B,): of the last steps that gained; looking.spectra, looking.sky: theirs. At the
        end, faint galaxies have the sizes and wings of their grids in theta
    chi2_at_end (B,): as if the prior were the first one, before the sizes of grids
    brightness (N,): of components, see `thresholds`; is_known (B,): scenes with an earlier fit
    begun (B, n, 4): the expected parameters, or those of an earlier fit where they are larger
    contamination (B, n): `contamination_factors` of these steps, of all components; the
        population's, which counts, is that of galaxies, by the steps that learn alone
    flux_estimate (N, 3, C): of faint galaxies' spectra the change to their mean, the scatter that
        is common to all channels, and that of each band, see shape_grid.py; 0 for others
    flux_doubt (N, C, k): changes of fluxes, see without_doubt.py and close_pairs.py
    """

    def __init__(self, looking: LinearisedScenes, noise, tol=CHI2_TOL):
        self.looking, self.noise, self.tol = looking, noise, tol
        shapes = [c.shape for c in looking.components]
        self.counts = np.array([len(shape.mean) for shape in shapes])
        self.at = looking.scene, looking.index
        size = looking.n_scenes, looking.n_most, N_PARAMETERS
        self.expected = PopulationPrior(shapes, *self.at, *size)
        self.population = deepcopy(self.expected)
        self.source = np.full(size[:2], -1)
        self.source[self.at] = [c.source for c in looking.components]
        self.theta, self.chi2 = self.population.mean.copy(), np.full(size[0], np.inf)
        self.chi2_at_end = self.chi2
        self.brightness = np.zeros(len(shapes))
        self.flux_estimate = np.repeat(np.zeros_like(looking.spectra)[:, None], 3, axis=1)
        self.flux_doubt = np.zeros((*looking.spectra.shape, 0))
        self.right = np.zeros((size[0], size[1] * size[2]))
        self.normal = [np.zeros(0)] * size[0]
        self.contamination = np.ones(size[:2])
        self.is_known, self.begun = np.zeros(size[0], bool), self.expected.mean
        self.moves = np.ones(size[:2], bool)

    def thetas(self, theta=None):
        """Parameters (n,) of each component."""
        theta = self.theta if theta is None else theta
        return [t[:n] for t, n in zip(theta[self.at], self.counts, strict=True)]

    def begin(self):
        """Solves at the mean."""
        self._take(np.arange(len(self.theta)))
        self._measure_brightness(self.theta)  # now with spectra

    def run(self):
        """Steps to the end, from two starts if galaxies are large; sets faint ones from grids."""
        some = np.unique(self.looking.scene[self.counts > 0])
        self._step(some, learn=True, until_grown=True)
        scenes = np.flatnonzero(_may_hold_large_galaxies(self))
        if len(scenes):
            _run_from_large_galaxies(self, scenes)
        run_without_doubt(self, some, scenes)
        run_from_equal_profiles(self, some)
        self.chi2_at_end = self.chi2_as_expected(np.arange(len(self.theta)))
        fit_faint_shapes(self, some)

    def _copy(self):
        """Copies of chi2, theta, the equations, the solution and the prior."""
        kept = self.looking.kept_solution(), deepcopy(self.population)
        equations = list(self.normal), self.right.copy(), self.contamination.copy()
        return self.chi2.copy(), self.theta.copy(), equations, *kept

    def _restore(self, before, scenes):
        """Restores some scenes (k,) from a `_copy`."""
        chi2, theta, (normal, right, contamination), solution, population = before
        self.chi2[scenes], self.theta[scenes] = chi2[scenes], theta[scenes]
        self.right[scenes], self.contamination[scenes] = right[scenes], contamination[scenes]
        for b in scenes:
            self.normal[b] = normal[b]
        self.looking.restore(solution, scenes)
        self.population.reset(scenes, population)
        self._measure_brightness(self.theta)

    def part(self, looking, chosen, noise):
        """ProfileFit of components (k,), those of `looking`, with the noise of its scenes."""
        part, here = ProfileFit(looking, noise, self.tol), tuple(np.array(self.at)[:, chosen])
        part.theta[part.at] = self.theta[here]
        part.population.mean[part.at] = self.population.mean[here]
        part.population.scatter[part.at] = self.population.scatter[here]
        return part

    def _take(self, scenes, *, doubt=True):
        """Solves some scenes and stores a step's inputs; doubt: contaminate shapes anew."""
        if len(scenes):
            self._measure_brightness(self.theta)
            self._look(scenes, self.theta, slopes=True)
            self.looking.solve(MODEL_ERROR)
            self.chi2[scenes] = self._chi2(scenes, self.theta)
            self._take_equations(scenes)
            if doubt:
                self.set_contamination(scenes, self.contamination[scenes])

    def _step(self, scenes, n_steps=N_STEPS, tol=None, *, learn=False, until_grown=False):
        """Step until some scenes have ended; tol: least gain, measured or expected; None: self.tol.

        until_grown: a scene also ends when one of its galaxies has grown by GROWN
        learn: update the prior after each step, of each scene until that takes back what the step
        gained: the doubt about a galaxy and its neighbours may alternate without an end. Chi2 is
        of the doubt at the end.
        """
        learning, tol = np.full(len(self.theta), learn), self.tol if tol is None else tol
        steps = StepControl(len(self.theta))
        live = np.isin(np.arange(len(self.theta)), scenes)
        for i_step in range(n_steps):
            scenes = np.flatnonzero(live)
            given = *self._equations(scenes), self.population.galaxies[scenes], self.moves[scenes]
            trial, expected, promised = steps.next(scenes, *given)
            on = expected >= tol
            live[scenes[~on]] = False
            scenes = scenes[on]
            if not len(scenes):
                break
            gain = self._try(scenes, trial[on])
            gained = gain > 0
            going = steps.take(scenes, gain, promised[on]) & ~_is_last(gain, promised[on], tol)
            live[scenes] = going & ~(until_grown & _have_grown(self)[scenes])
            if gained.any():
                self._take_equations(scenes[gained])
            some = scenes[gained & live[scenes] & learning[scenes]]
            if len(some) and i_step < n_steps - 1:
                learning[some] = self._learn(some) <= gain[np.searchsorted(scenes, some)]
        if learn:
            scenes = np.flatnonzero(~learning)
            self.set_contamination(scenes, self.contamination[scenes])

    def _try(self, scenes, trial):
        """Tries parameters (k, n, 4) of each of the scenes; the gains (k,).

        Keeps the better state of each.
        """
        theta, before = self.theta.copy(), self.looking.kept_solution()
        theta[scenes] = trial
        self._look(scenes, theta, slopes=True)
        self.looking.solve(MODEL_ERROR)
        new = self._chi2(scenes, theta)
        gain = self.chi2[scenes] - new
        better = gain > 0
        self.looking.restore(before, scenes[~better])
        self.chi2[scenes[better]], self.theta[scenes[better]] = new[better], trial[better]
        self._measure_brightness(self.theta)
        return gain

    def _look(self, scenes, theta, *, slopes):
        slopes = slopes & self.moves[self.at]
        self.looking.render(scenes, self.thetas(theta), self.brightness, slopes=slopes)

    def solve_shapes(self, scenes):
        """Renders and solves scenes (k,) with their present shapes."""
        self._look(scenes, self.theta, slopes=False)
        self.looking.solve(MODEL_ERROR)

    def _chi2(self, scenes, theta):
        """With the priors (k,)."""
        return self.looking.compute_residuals(MODEL_ERROR) + self.population.penalty(scenes, theta)

    def chi2_as_expected(self, scenes):
        """Chi2 (k,) with the priors as they were before any scene was fitted."""
        learned = self.population.penalty(scenes, self.theta)
        return self.chi2[scenes] - learned + self.expected.penalty(scenes, self.theta)

    def _learn(self, scenes):
        """Updates the prior of some scenes from the present parameters; increase (k,) of chi2."""
        before = self.population.penalty(scenes, self.theta)
        self.population.update(scenes, self.theta, self.own_equations(scenes))
        increase = self.population.penalty(scenes, self.theta) - before
        self.chi2[scenes] += increase
        return increase + self.set_contamination(scenes, self.contamination[scenes])

    def set_contamination(self, scenes, contamination):
        """Stores the contamination (k, n) that counts in some scenes; increase (k,) of chi2."""
        before = self.population.penalty(scenes, self.theta)
        self.population.set_contamination(scenes, contamination)
        increase = self.population.penalty(scenes, self.theta) - before
        self.chi2[scenes] += increase
        return increase

    def measure_contamination(self, scenes):
        """The `contamination_factors` (k, n) of some of the scenes solved last."""
        looking = self.looking
        rows = looking.rows_of(scenes)
        normal, spectra = looking.normal[rows][..., :-1, :-1], looking.solution()[rows][..., :-1]
        given = self.source[scenes], self.population.stars[scenes]
        return contamination_factors(normal, spectra, *given)

    def _take_equations(self, scenes):
        """Stores the normal equations and contamination of some of the scenes solved last."""
        self.contamination[scenes] = self.measure_contamination(scenes)
        for b in scenes:
            self.normal[b] = np.zeros(0)  # before there are others
        normal, right = normal_equations(self.looking)
        for b, row in zip(scenes, self.looking.rows_of(scenes), strict=True):
            self.normal[b], self.right[b] = normal[row].copy(), right[row]

    def _equations(self, scenes):
        """Equations of some scenes, as `StepControl.next` takes them."""
        right, normal = self.right[scenes], [self.normal[b] for b in scenes]
        prior = self.population.precision(scenes, self.theta).reshape(right.shape)
        away = self.population.mean[scenes] - self.theta[scenes]
        return normal, prior, right + prior * away.reshape(right.shape), self.theta[scenes]

    def own_equations(self, scenes):
        """Normal matrices (k, n, 4, 4) of each component of some scenes alone, prior included."""
        n, p = self.theta.shape[1:]
        own = [np.einsum("iqir->iqr", self.normal[b].reshape(n, p, n, p)) for b in scenes]
        return add_diagonal(
            np.reshape(own, (-1, n, p, p)), self.population.precision(scenes, self.theta)
        )

    def _measure_brightness(self, theta):
        """Stores the components' peaks over a model pixel's noise, in their best channel."""
        best = (self.looking.spectra / self.noise[self.looking.scene]).max(axis=1)
        self.brightness = best * peaks_of(self.looking.components, self.thetas(theta))


def _is_last(gain, promised, tol):
    """Selects steps (k,) with gains in chi2 too small for others; see MAX_SHORTFALL."""
    return (gain > 0) & (gain < tol) & (promised < MAX_SHORTFALL * tol)


def start_from(fit, known):
    """Sets parameters of an earlier fit {component: (n,)} in a ProfileFit; solves their scenes."""
    galaxies = [i for i in known if fit.counts[i]]
    for i in galaxies:
        fit.theta[fit.looking.scene[i], fit.looking.index[i], : fit.counts[i]] = known[i]
    scenes = np.unique(fit.looking.scene[galaxies])
    fit.is_known[scenes], fit.begun = True, np.maximum(fit.theta, fit.begun)
    fit._take(scenes)


def growth(fit, begun=None):
    """ln sigma (B, n) of galaxies beyond the expected one, or that of `begun`; 0 of others."""
    begun = fit.expected.mean if begun is None else begun
    return (fit.theta - begun)[..., 0] * fit.expected.galaxies


def _have_grown(fit):
    """Selects scenes (B,) with a galaxy that has grown by GROWN since it began."""
    return growth(fit, fit.begun).max(axis=1) > GROWN


def _may_hold_large_galaxies(fit):
    """Selects scenes (B,) that may hold large galaxies, or whose data are unexplained.

    Galaxies of an earlier fit, which has looked for larger ones, count if they have grown since. It
    leaves structure to be fitted, so that its smooth profiles never explain all of the data.
    """
    unexplained = (fit.chi2 > MAX_CHI2 * fit.looking.n_pixels()) & ~fit.is_known
    return (growth(fit, fit.begun).max(axis=1) > MAX_GROWTH) | unexplained


def _run_from_large_galaxies(fit, scenes):
    """Fits scenes (k,) of a ProfileFit again from profiles of large galaxies.

    The better fit of each stays. The first one goes on where it was ended because a galaxy had
    grown.
    """
    before, chi2 = fit._copy(), fit.chi2_as_expected(scenes)
    grown = _have_grown(fit)[scenes]
    some = begin_with_large_galaxies(fit, scenes)
    fit._take(scenes[some])
    fit._step(scenes[some], learn=True)
    better = some & (fit.chi2_as_expected(scenes) < chi2)
    fit._restore(before, scenes[~better])
    fit._step(scenes[~better & grown], learn=True)
