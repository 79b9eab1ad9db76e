"""Size and wings of faint galaxies from a grid, where least squares do not give them.

Chi2 of a faint galaxy is far from quadratic in ln sigma and ln beta: profiles of half and of twice
its flux may fit as well, and steps from a small profile do not reach a large one. On a grid of both
the flux of every profile u is solved for, with neighbours as they are, which changes chi2 by

    -gain = -sum_c max(0, b)^2 / p,    b = <u, r>,    p = <u, u>,

where r is the data minus the models of all others, and the sky's level is eliminated from b and p.
Of far larger profiles it is at most `contamination` times what errors of the neighbours' models
leave of it, see alternatives.py.
If a profile is better than the fitted one, the scene is fitted again from it. The weights

    exp(gain / (2 contamination)) ((1 - UNUSUAL) prior + UNUSUAL / (SIZE_RANGE WINGS_RANGE))

are the posterior of size and wings. The prior and the contamination are the population's
(population.py); unusual galaxies have any size and wings, and get the mean of both if most of the
weight is theirs. Others, and those without significant light, stay as they are.

Fluxes f_k are skewed about that of one profile, and larger profiles have more noise n_k^2. With
weights w_k of more unusual galaxies, UNUSUAL_IN_FLUXES, catalogues have the mean of all profiles,

    f = f_0 + (sum w_k f_k - f_0) / contamination
    var = sum w_k (f_k - f)^2 + sum w_k (n_k^2 - n_0^2)

for the flux f_0 and the noise n_0 of the profile that is set, and errors have both parts of the
variance, the second one for each band alone (posterior.py). In the light of neighbours the
weights are the prior's alone, and the flux stays. It also stays where the grid has a better profile
that the fit of all galaxies refused, since that profile holds a neighbour's light, and where the
fitted profile has no light, since its contamination is not known then.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ..profiles import GalaxyGaussians, GalaxyProfile
from .alternatives import Alternatives
from .first_profiles import NEED
from .population import LEARNED

# Smallest error of ln sigma of galaxies with a grid. With 0.08 a flux at signal to noise 40 is 0.75
# of the truth, six of its errors (bench.ladder, n = 2.5), since wings that it has are not found.
MIN_SIZE_ERROR = 0.05
# Fraction of galaxies of any size and wings, and the ranges of both. With 0.1, galaxies of n = 4
# at signal to noise 10 to 20 are fainter by 0.15 of their errors (bench.ladder).
UNUSUAL, SIZE_RANGE, WINGS_RANGE = 0.3, 4.0, 3.0
# The same fraction for the mean and scatter of fluxes, since models are better with a narrower
# prior than both. With 0.3 61 to 68 % of fluxes of galaxies of r_e 1.2 to 4 px at signal to noise 7
# to 20 are within their errors, with 0.7 67 to 73 %, and of galaxies of 4 to 32 px 63 to 69 % with
# both (bench.ladder, single).
UNUSUAL_IN_FLUXES = 0.7
# Posterior fraction of unusual galaxies from which an estimate moves. If all move, median SDRs of
# simulated COSMOS galaxies are 0.3 dB lower in Euclid's images (32 scenes, seed 3000).
MIN_UNUSUAL = 0.5
# Steps from the fitted ln sigma, and the values of ln beta at each of them. With -2.1 as the least,
# galaxies of n = 4 at signal to noise 10 to 20 are fainter by 0.2 of their errors (bench.ladder).
SIZE_STEPS, LN_BETA = np.arange(-2, 5) * 0.3, np.array([1.9, 0.4, -1.1, -2.6])
# Further steps for galaxies whose light gains less than MAX_FAR_GAIN, and their ln beta: light of
# galaxies of r_e over 25 px at signal to noise 10 to 15 is not significant in a small profile
# (bench.ladder). Each of them stands for twice the step in size, and for all wings.
MAX_FAR_GAIN, FAR_STEPS, FAR_LN_BETA = 2 * NEED, np.array([1.8, 2.4, 3.0, 3.6]), 0.9
FAR_WEIGHT = 2.0 * len(LN_BETA)
# Smallest decrease of chi2 for another fit.
MIN_GAIN = 1.0
# Largest numbers of galaxies of a scene, and of frames' pixels times profiles, rendered at once.
MAX_AT_ONCE, MAX_PIXELS = 8, 30_000_000


def fit_faint_shapes(fit, scenes):
    """Sets size and wings of faint galaxies in some scenes (k,) of a ProfileFit from their grids.

    Stores the changes and errors of their fluxes in its `flux_estimate`.
    """
    grids = _grids(fit, _uncertain(fit, scenes))
    better = {i: grid.theta[k] for i, grid in grids.items() if (k := grid.best(fit))}
    if better:
        changed = _fitted_again(fit, better)
        grids |= _grids(fit, [i for i in grids if fit.looking.scene[i] in changed])
    for i, grid in grids.items():
        fit.theta[grid.scene, grid.index], fit.flux_estimate[i] = grid.posterior(fit)


@dataclass(frozen=True, eq=False)
class ShapeGrid:
    """Alternative profiles of one component, the present one first; see the module's text.

    scene, index: of the component; theta (K, 4); gain (K,); flux, variance (K, C): in the frame,
        in the views' units, the first b / p of both signs, the latter by noise alone
    """

    scene: int
    index: int
    theta: np.ndarray
    gain: np.ndarray
    flux: np.ndarray
    variance: np.ndarray

    def contamination(self, fit):
        """Factor by which errors of its neighbours' models lower the data's precision."""
        return fit.population.contamination[self.scene, self.index]

    def best(self, fit):
        """Index of the best profile with significant light, 0 if it gains less than MIN_GAIN."""
        loss = fit.population.penalty_of(self.scene, self.index, self.theta) - self.gain
        best = int(np.argmin(loss))
        significant = self.gain[best] >= NEED * self.contamination(fit)
        return best if significant and loss[best] < loss[0] - MIN_GAIN else 0

    def posterior(self, fit):
        """Parameters (4,) to be set, and their row (3, C) of `ProfileFit.flux_estimate`."""
        theta, gain = self.theta[1:], self.gain[1:]
        flux, variance = self.flux[1:], self.variance[1:]
        at = self.scene, self.index, LEARNED
        scatter, contamination = fit.population.scatter[at], self.contamination(fit)
        away = (theta[:, LEARNED] - fit.population.mean[at]) / scatter
        usual = np.exp(-np.square(away).sum(axis=1) / 2) / (2 * np.pi * scatter.prod())
        n_near, found = len(SIZE_STEPS) * len(LN_BETA), self.theta[0]
        about, noise_0 = self.flux[0], self.variance[0]
        near = np.exp((gain[:n_near] - gain[:n_near].max()) / (2 * contamination))
        weight, unusual = _weights(near, usual[:n_near], UNUSUAL)
        if unusual > MIN_UNUSUAL and self.gain.max() >= NEED * contamination:
            found, about = weight @ theta[:n_near], weight @ flux[:n_near]
            noise_0 = weight @ variance[:n_near]
        likelihood = np.exp((gain - gain.max()) / (2 * contamination))
        likelihood[n_near:] *= FAR_WEIGHT
        weight, _ = _weights(likelihood, usual, UNUSUAL_IN_FLUXES)
        stays = self.best(fit) > 0 or self.gain[0] <= 0
        change = 0 * about if stays else (weight @ flux - about) / contamination
        scatter = np.sqrt(weight @ np.square(flux - about - change))
        noise = np.sqrt(np.maximum(weight @ variance - noise_0, 0))
        return found, np.stack([change, scatter, noise])


def _weights(likelihood, usual, fraction):
    """Posterior weights (K,) of profiles with a fraction of unusual galaxies, and that of these.

    usual (K,): density of the prior of others
    """
    unusual = likelihood * fraction / (SIZE_RANGE * WINGS_RANGE)
    weight = likelihood * (1 - fraction) * usual + unusual
    return weight / weight.sum(), unusual.sum() / weight.sum()


def _uncertain(fit, scenes):
    """Galaxies in some scenes (k,) whose sizes have large errors, as a list of components."""
    uncertain = np.zeros(fit.source.shape, bool)
    uncertain[scenes] = np.linalg.inv(fit.own_equations(scenes))[..., 0, 0] > MIN_SIZE_ERROR**2
    return [
        i
        for i, c in enumerate(fit.looking.components)
        if isinstance(c.shape, GalaxyProfile) and c.shape.whole and uncertain[c.scene, c.index]
    ]


def _grids(fit, components):
    """The ShapeGrids {component: grid}, of few components at once."""
    rounds, count, n_pixels = [[]], {}, 0
    for i in components:
        own = fit.looking.components[i]
        n = np.prod(own.frame) * (1 + len(SIZE_STEPS) * len(LN_BETA) + len(FAR_STEPS))
        if count.get(own.scene, 0) == MAX_AT_ONCE or (rounds[-1] and n_pixels + n > MAX_PIXELS):
            rounds.append([])
            count, n_pixels = {}, 0
        count[own.scene], n_pixels = count.get(own.scene, 0) + 1, n_pixels + n
        rounds[-1].append(i)
    return {i: grid for some in rounds if some for i, grid in _computed(fit, some)}


def _computed(fit, components):
    """Pairs of some components and their ShapeGrids."""
    looking, thetas = fit.looking, fit.thetas()
    fit.solve_shapes(np.unique(looking.scene[components]))
    row, present = looking.rows_of(looking.scene[components]), looking.spectra[components]
    power = looking.normal[row, :, looking.index[components], looking.index[components]]
    explained = (np.square(present) * power).sum(axis=1)
    own = {
        i: _alternatives(thetas[i], far=light < MAX_FAR_GAIN)
        for i, light in zip(components, explained, strict=True)
    }
    found = Alternatives(fit, own)
    off, level = (a[row] for a in looking.of_level())
    right, alone, owner = found.right, found.alone, found.owner
    if looking.fit_sky:
        off = (off + present * found.level[found.first])[owner]
        part = found.level / np.where(level > 0, level, np.inf)[owner]
        right, alone = right - part * off, alone - part * found.level
    right, alone = found.tied(right), found.tied(alone)
    flux = np.divide(right, alone, out=np.zeros_like(right), where=alone > 0)
    contamination = fit.population.contamination[fit.at][found.component]
    gain = found.full_gain(right, alone)
    certain = np.minimum(gain, contamination * found.certain_gain(right, alone))
    n_near = 1 + len(SIZE_STEPS) * len(LN_BETA)
    gain = np.where(np.arange(len(gain)) - found.first[owner] < n_near, gain, certain)
    inside = part_inside(found.listed, np.array(found.theta))[:, None]
    variance = np.divide(inside**2, alone, out=np.zeros_like(alone), where=alone > 0)
    parts = gain, flux * inside, variance
    for q, i in enumerate(components):
        at = looking.scene[i], looking.index[i]
        yield i, ShapeGrid(*at, own[i], *(part[owner == q] for part in parts))


def _alternatives(theta, *, far):
    """Parameters (K, 4) of the present profile (4,), of those near it and, if `far`, of larger."""
    ln_beta = LN_BETA.copy()
    ln_beta[np.argmin(np.abs(ln_beta - theta[3]))] = theta[3]
    larger = FAR_STEPS if far else ()
    pairs = [*itertools.product(SIZE_STEPS, ln_beta), *((s, FAR_LN_BETA) for s in larger)]
    out = np.tile(theta, (1 + len(pairs), 1))
    step, out[1:, 3] = np.array(pairs).T
    out[1:, 0] += step
    return out


def part_inside(components, theta):
    """Fractions (n,) of the light of galaxies inside their frames, as if these were round."""
    half = np.array([min(c.frame) for c in components]) / 2
    moment = np.array([c.shape.psf_moment for c in components])
    theta = theta * [1, 0, 0, 1]
    return 1 - GalaxyGaussians(theta, moment).outside(half)


def _fitted_again(fit, better):
    """Fits scenes again from {component: parameters}; those (k,) for which that is better."""
    looking, before = fit.looking, fit._copy()
    scenes = np.unique(looking.scene[list(better)])
    for i, theta in better.items():
        fit.theta[looking.scene[i], looking.index[i]] = theta
    fit._take(scenes, doubt=False)
    fit._step(scenes)
    stays = before[0][scenes] <= fit.chi2[scenes]
    fit._restore(before, scenes[stays])
    return scenes[~stays]
