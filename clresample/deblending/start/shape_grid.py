"""Size and wings of faint galaxies from a grid, where least squares give neither value nor error.

Chi2 of a faint galaxy is far from quadratic in ln sigma and ln beta: galaxies of half or twice the
flux may fit as well, and steps from a small profile do not reach a large one. On a grid of both
every profile u is solved for alone, its neighbours as they are, which gains in chi2

    gain = sum_c max(0, b)^2 / p,    b = <u, r>,    p = <u, u>,

r is the data without the models of all others, and the sky's level is eliminated from b and p.
Where a profile is better than the least squares', the scene is fitted again from it. The posterior,

    w ~ exp(gain / 2 contamination) ((1 - UNUSUAL) prior + UNUSUAL / (SIZES WINGS)),

has a mean, at which size and wings are set, and a scatter of the flux, which errors hold
(posterior.py). The prior is the population's. UNUSUAL galaxies have any size and wings.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ..profiles import GalaxyProfile
from ..spectra import MODEL_ERROR
from .component_batch import peaks_of, renumbered
from .first_profiles import NEED

# Smallest error of ln sigma of a galaxy whose grid is computed, and least gain of its best profile.
MIN_SIZE_ERROR = 0.08
# Part of galaxies of any size and wings, and the range of both.
UNUSUAL, SIZES, WINGS = 0.3, 4.0, 3.0
# Posterior fraction
MOVED = 0.5
# Steps in ln sigma from the fitted one, with each ln beta; and larger ones, with two of them, from
# which a galaxy is only fitted again.
SIZE_STEPS = np.arange(-2, 5) * 0.3
LN_BETA = np.array([1.9, 0.9, -0.1, -1.1, -2.1])
FAR_STEPS, FAR_LN_BETA = np.array([1.8, 2.4, 3.0, 3.6]), LN_BETA[[1, 2]]
# Largest number of galaxies of a scene whose grids are rendered at once.
MAX_AT_ONCE = 8


def fit_faint_shapes(fit, scenes):
    """Sets size and wings of faint galaxies of some scenes (k,) of a ProfileFit from their grids.

    Stores the scatter of their fluxes in its `flux_scatter`.
    """
    grids = _grids(fit, _uncertain(fit, scenes))
    better = {g.component: g.theta[g.best(fit)] for g in grids if g.best(fit)}
    if better:
        changed = _fitted_again(fit, better)
        again = [g.component for g in grids if fit.looking.scene[g.component] in changed]
        fresh = {g.component: g for g in _grids(fit, again)}
        grids = [fresh.get(g.component, g) for g in grids]
    for g in grids:
        if g.gain.max() / g.contamination(fit) >= NEED:
            theta, fit.flux_scatter[g.component] = g.posterior(fit)
            fit.theta[g.place(fit)] = theta
    fit._measure_brightness(fit.theta)


@dataclass(frozen=True, eq=False)
class ShapeGrid:
    """Alternatives of one component's profile, the present one first, see the module's text.

    component: its index; theta (K, 4), gain (K,), flux (K, C): in the frame, in the views' units
    """

    component: int
    theta: np.ndarray
    gain: np.ndarray
    flux: np.ndarray

    def place(self, fit):
        """Its scene, and its index there."""
        return fit.looking.scene[self.component], fit.looking.index[self.component]

    def contamination(self, fit):
        """Factor by which its neighbours' errors lower the data's precision."""
        return fit.population.contamination[self.place(fit)]

    def best(self, fit):
        """The best alternative, 0 if none is better than the present one by enough."""
        loss = fit.population.penalty_of(*self.place(fit), self.theta) - self.gain
        k = int(np.argmin(loss))
        enough = self.gain[k] >= NEED * self.contamination(fit) and loss[k] < loss[0] - 1.0
        return k if enough else 0

    def posterior(self, fit):
        """Parameters (4,) and the fluxes' scatter (C,) about theirs."""
        near = np.arange(1 + len(SIZE_STEPS) * len(LN_BETA))[1:]
        b, i = self.place(fit)
        mean, scatter = fit.population.mean[b, i, [0, 3]], fit.population.scatter[b, i, [0, 3]]
        theta, flux = self.theta[near], self.flux[near]
        away = (theta[:, [0, 3]] - mean) / scatter
        usual = np.exp(-(away**2).sum(axis=1) / 2) / (2 * np.pi * scatter.prod())
        prior = (1 - UNUSUAL) * usual + UNUSUAL / (SIZES * WINGS)
        gain = self.gain[near]
        weight = np.exp((gain - gain.max()) / 2 / self.contamination(fit)) * prior
        weight /= weight.sum()
        unusual = weight @ (UNUSUAL / (SIZES * WINGS) / prior)
        if unusual < MOVED:
            return self.theta[0], np.sqrt(weight @ (flux - self.flux[0]) ** 2)
        return weight @ theta, np.sqrt(weight @ (flux - weight @ flux) ** 2)


def _uncertain(fit, scenes):
    """Components of some scenes (k,) whose sizes have large errors, with neighbours fixed."""
    looking = fit.looking
    k, (n, p) = len(scenes), fit.theta.shape[1:]
    each = fit.normal[scenes].reshape(k, n, p, n, p)[:, np.arange(n), :, np.arange(n)]
    variance = np.linalg.inv(each)[..., 0, 0].T * fit.population.contamination[scenes]
    row = dict(zip(scenes.tolist(), range(k), strict=True))
    return [
        i
        for i, c in enumerate(looking.components)
        if c.scene in row
        and isinstance(c.shape, GalaxyProfile)
        and c.shape.whole
        and variance[row[c.scene], c.index] > MIN_SIZE_ERROR**2
    ]


def _alternatives(theta):
    """Parameters (K, 4) of the profiles compared with the present ones (4,), these first."""
    wings = LN_BETA.copy()
    wings[np.argmin(np.abs(wings - theta[3]))] = theta[3]
    pairs = [*itertools.product(SIZE_STEPS, wings), *itertools.product(FAR_STEPS, FAR_LN_BETA)]
    out = np.tile(theta, (1 + len(pairs), 1))
    step, out[1:, 3] = np.array(pairs).T
    out[1:, 0] += step
    return out


def _grids(fit, components):
    """The ShapeGrids of some components, few of each scene at once."""
    looking, count, rounds = fit.looking, {}, {}
    for i in components:
        n = count[looking.scene[i]] = count.get(looking.scene[i], -1) + 1
        rounds.setdefault(n // MAX_AT_ONCE, []).append(i)
    return [grid for some in rounds.values() for grid in _rendered(fit, some)]


def _rendered(fit, components):
    """The ShapeGrids of some components."""
    looking, scenes = fit.looking, np.unique(fit.looking.scene[components])
    fit._look(scenes, fit.theta, slopes=False)
    looking.solve(MODEL_ERROR)
    looking.compute_residuals(MODEL_ERROR)
    row = looking.rows_of(looking.scene[components])
    level = [a[row] for a in looking.of_level()]
    theta = [_alternatives(fit.thetas()[i]) for i in components]
    owner = np.repeat(np.arange(len(components)), [len(own) for own in theta])
    first, theta = np.flatnonzero(np.diff(owner, prepend=-1)), np.concatenate(theta)
    listed = renumbered(looking.components[components[q]] for q in owner)
    around = looking.with_components(listed)
    peak = peaks_of(listed, list(theta)) / peaks_of(listed, list(theta[first][owner]))
    bright = fit.brightness[np.array(components)[owner]] * np.minimum(peak, 1)
    around.render(scenes, list(theta), bright, slopes=False)
    right, alone, with_sky = _products(around, looking.spectra[components], owner, first)
    if looking.fit_sky:
        (off, curvature), a = level, looking.spectra[components]
        off = off + a * with_sky[first]
        share = np.divide(with_sky, curvature[owner], where=curvature[owner] > 0, out=0 * with_sky)
        right, alone = right - share * off[owner], alone - share * with_sky
    if looking.ties is not None:
        right, alone = (looking.ties.spread(looking.ties.total(a)) for a in (right, alone))
    flux = np.divide(np.maximum(right, 0), alone, where=alone > 0, out=0 * alone)
    gain = right * flux if looking.ties is None else (right * flux)[:, looking.ties.first]
    flux = flux * _part_inside(listed, theta)[:, None]
    parts = np.split(np.arange(len(owner)), first[1:])
    gain = gain.sum(axis=1)
    return [
        ShapeGrid(i, theta[own], gain[own], flux[own])
        for i, own in zip(components, parts, strict=True)
    ]


def _products(around, spectra, owner, first):
    """Products (n, C) of alternatives with the data without others, themselves, and the sky.

    spectra (q, C): of the present profiles, the `first` (q,) of each owner's; owner (n,)
    """
    right, alone, sky = np.zeros((3, len(owner), spectra.shape[1]))
    for sight in around.sights:
        table, _ = sight.overlapping_pairs()
        one, other = around.at[table[:, :2]].T
        present = np.isin(one, first) | np.isin(other, first)
        table = table[(owner[one] == owner[other]) & ((one == other) | present)]
        gram = sight.gram(around.device.put(table.astype(np.int32)), 1)[..., 0, 0]
        pull = sight.residual_products(1)[:, :, 0]
        right[around.at, sight.channels] = pull[..., 0]
        sky[around.at, sight.channels] = pull[..., 1]
        one, other = around.at[table[:, :2]].T
        alone[one[one == other], sight.channels] = gram[one == other]
        own = spectra[owner[one]][:, sight.channels] * gram
        for a, b in ((one, other), (other, one)):
            use = np.isin(b, first) & ((a != b) | (a is one))
            right[a[use], sight.channels] += own[use]
    return right, alone, sky


def _part_inside(components, theta):
    """Parts (n,) of the light of galaxies inside their frames, as if these were round."""
    half = np.array([min(c.frame) for c in components]) / 2
    beta = np.exp(theta[:, 3])
    width = np.exp(2 * theta[:, 0]) + np.array([np.trace(c.shape.psf_moment) / 2 for c in components])
    return 1 - (1 + half**2 / width / (2 * beta)) ** -beta


def _fitted_again(fit, better):
    """Fits scenes again from {component: parameters}; those (k,) that are better for it."""
    looking = fit.looking
    scenes, before = np.unique(looking.scene[list(better)]), fit._copy()
    for i, theta in better.items():
        fit.theta[looking.scene[i], looking.index[i]] = theta
    fit._measure_brightness(fit.theta)
    fit._look(scenes, fit.theta, slopes=True)
    looking.solve(MODEL_ERROR)
    fit.chi2[scenes] = fit._chi2(scenes, fit.theta)
    fit._take_equations(scenes)
    fit._step(scenes)
    worse = before[0][scenes] <= fit.chi2[scenes]
    fit._restore(before, scenes[worse])
    return scenes[~worse]
