"""Chooses the profiles of large galaxies from a coarse grid, for a second start.

The first start is from the expected profiles, galaxies of a few pixels. If one galaxy of a scene is
far larger, small profiles of all sources share its light at first, and each grows into it.
Where one grew, the first start ends (profile_fit._have_grown). Sizes GROWTH times apart, with the
expected wings and with WIDE_WINGS, are compared by

    gain_k = sum_c max(0, <u_k, r>)^2 / (|u_k|^2 + (NEIGHBOUR_MODEL_ERROR <u_k, M>)^2),

where u_k is a source's whitened image with profile k, r is the data minus the models of the sources
before it, and M are these models. The term with M allows for their error, NEIGHBOUR_MODEL_ERROR of
their light (population.py), so that a small neighbour does not fit that error. The source with the
largest gain comes first, with its best profile, whose shape is then fitted. The source with the
largest gain in the residuals is next, and so on: the result does not depend on the order of the
list.
"""

from __future__ import annotations

import numpy as np

from ..linear.component_batch import renumbered
from ..linear.spectra import MODEL_ERROR
from ..profiles import GalaxyProfile
from .population import NEIGHBOUR_MODEL_ERROR

# Ratio of successive sizes: least squares converge from half of it.
GROWTH = 3.0
# Beta of large galaxies with wings: fits of Sersic profiles of n = 1 to 4 have 1.5 to 0.1.
WIDE_WINGS = 0.7
# Largest number of rounds, in each of which separate sources get their profiles; the remaining
# sources are left to the least squares.
N_ROUNDS = 12
# Smallest gain in chi2 of another profile. Noise gains less than 10 for the few parameters of a
# profile; smaller differences are left to the least squares, which include the prior.
NEED = 25.0
# Largest number of steps after each large profile that is added, before all are fitted together:
# these end where they gain less than NEED, as smaller differences do not choose profiles.
N_FIRST_STEPS = 5


def profile_grid(looking, scenes, thetas, error) -> dict:
    """Parameters of galaxies that may be larger than expected: {component: [theta, ...]}.

    A larger profile enters if the light around the source is more significant with its weights than
    with those of the profile before, by over NEED.

    looking: LinearisedScenes of which `scenes` (k,) are solved at `thetas` (N), the expected
        parameters
    error: part of the light that adds to the noise
    """
    here = np.flatnonzero(np.isin(looking.scene, scenes)).tolist()
    going = [i for i in here if isinstance(looking.components[i].shape, GalaxyProfile)]
    going = [i for i in going if looking.components[i].shape.whole]
    if not going:
        return {}
    before = dict(zip(here, _significance(looking, looking.sky, error)[here], strict=True))
    grid: dict[int, list] = {}
    while going:
        sizes = {i: grid.get(i, [thetas[i]])[-1][0] + np.log(GROWTH) for i in going}
        sizes = {i: s for i, s in sizes.items() if 2 * np.exp(s) < max(looking.components[i].frame)}
        if not sizes:
            break
        larger = {i: np.array([size, *thetas[i][1:]]) for i, size in sizes.items()}
        now = _significance(_instead(looking, list(larger.items())), looking.sky, error)
        going = [i for i, new in zip(larger, now, strict=True) if new > before[i] + NEED]
        before = dict(zip(larger, now, strict=True))
        for i in going:
            grid.setdefault(i, [thetas[i]]).append(larger[i])
    for own in grid.values():
        own += [np.array([*theta[:3], np.log(WIDE_WINGS)]) for theta in own]
    return grid


def begin_with_large_galaxies(fit, scenes):
    """Sets the parameters of scenes (k,) of a ProfileFit anew; which have large galaxies (k,)."""
    fit.theta[scenes] = fit.expected.mean[scenes]
    fit.population.reset(scenes, fit.expected)
    fit.solve_shapes(scenes)
    return first_profiles(fit, scenes, MODEL_ERROR)[scenes].any(axis=1)


def first_profiles(fit, scenes, error):
    """Sets the parameters of large galaxies in some scenes (k,) of a ProfileFit, and selects them.

    They are bool (B, n), of all scenes and their components.

    fit: solved at its means in these scenes; error: part of the light that adds to the noise
    """
    looking, thetas = fit.looking, fit.thetas()
    grid = profile_grid(looking, scenes, thetas, error)
    scenes = np.unique(looking.scene[list(grid)])
    # sources without wider light around them are included from the start
    models = {i: thetas[i] for i in np.flatnonzero(np.isin(looking.scene, scenes)) if i not in grid}
    large: set[int] = set()
    for _ in range(N_ROUNDS):
        rest = {i: own for i, own in grid.items() if i not in models}
        rest = {i: own for i, own in rest.items() if looking.scene[i] in scenes}
        if not rest:
            break
        chosen = _next(looking, models, rest, error)
        scenes = np.unique(looking.scene[list(chosen)]) if chosen else scenes[:0]
        models |= chosen
        new = {i for i, theta in chosen.items() if theta is not grid[i][0]}
        large |= new
        if new:
            models = _fit_part(fit, models, large, np.unique(looking.scene[list(new)]))
    found = np.zeros(fit.source.shape, bool)
    for i in large:
        at = looking.scene[i], looking.index[i]
        fit.theta[*at, : len(models[i])], found[at] = models[i], True
    return found


def _fit_part(fit, thetas, free, scenes):
    """Fits profiles of some components without the others; their parameters, as `thetas`.

    thetas: {component: parameters (n,)}; free: set of those that move; scenes (k,): that are
        fitted, others stay as they are
    """
    here = [i for i in thetas if fit.looking.scene[i] in scenes]
    looking = fit.looking.with_components(renumbered(fit.looking.components[i] for i in here))
    part = fit.part(looking, here, fit.noise)
    for b, k, i in zip(*part.at, here, strict=True):
        part.theta[b, k, : len(thetas[i])] = thetas[i]
        part.moves[b, k] = i in free
    part._take(scenes)
    part._step(scenes, N_FIRST_STEPS, NEED)
    return thetas | dict(zip(here, part.thetas(), strict=True))


def _next(looking, models, rest, error):
    """Selects in each scene the components of the largest gain nearby: {component: best theta}.

    Scenes add some only if a larger profile gains more than the first one by over NEED.

    models: those before it, {component: theta}; rest: {component: [theta expected, ...]}
    """
    listed = [(i, theta) for i, own in rest.items() for theta in own]
    component = np.array([i for i, _ in listed])
    around, right, light, alone = products_beside(looking, models, listed, error)
    noise = alone + (NEIGHBOUR_MODEL_ERROR * (light - right)) ** 2
    square = np.maximum(right, 0) ** 2
    gain = np.divide(square, noise, out=np.zeros_like(noise), where=alone > 0).sum(axis=1)
    # of each component the best profile
    first = np.flatnonzero(np.diff(component, prepend=-1))
    best = np.array([a + np.argmax(gain[a:b]) for a, b in zip(first, [*first[1:], len(gain)])])
    going = np.unique(around.scene[best][gain[best] > gain[first] + NEED])
    at = best[np.isin(around.scene[best], going)]
    return dict(apart(around, listed, gain, at))


def products_beside(looking, models, listed, error):
    """LinearisedScenes of components [(i, theta)], and three products (n, C) of their images.

    With the data minus the models {component: theta}, with the data, and with themselves.
    """
    sky, modelled = looking.sky.copy(), np.zeros(0, int)
    if models:
        before = _instead(looking, list(models.items()))
        before.solve(error)
        before.compute_residuals(error)
        modelled = before.scenes
        sky[modelled] = before.sky[modelled]
    around = _instead(looking, listed)
    right = np.zeros((len(listed), looking.n_channels))
    for sight in around.sights:
        right[around.at, sight.channels] = sight.residual_products(1)[:, :, 0, 0]
    if looking.ties is not None:
        right = looking.ties.spread(looking.ties.total(right))
    light, alone = around.light_products(sky, error)
    right = np.where(np.isin(around.scene, modelled)[:, None], right, light)
    return around, right, light, alone


def apart(around, listed, gain, at):
    """Selects the components of the largest gain (n,) at these places, with disjoint boxes.

    listed (n): components; at: the places among them that compete
    """
    low, high = np.zeros((2, len(listed), 2))
    slots = around.slots
    low[around.at], high[around.at] = slots.origin, slots.origin + slots.pixel[:, None] * slots.size
    taken: list[int] = []
    for k in at[np.argsort(-gain[at], kind="stable")]:
        same = [j for j in taken if around.scene[j] == around.scene[k]]
        if not ((low[same] < high[k]) & (low[k] < high[same])).all(axis=1).any():
            taken.append(int(k))
    return [listed[k] for k in taken]


def _instead(looking, listed):
    """LinearisedScenes rendered with components [(i, theta)] in place of the present ones."""
    around = looking.with_components(renumbered(looking.components[i] for i, _ in listed))
    scenes, thetas = np.unique(around.scene), [theta for _, theta in listed]
    around.render(scenes, thetas, np.zeros(len(listed)), slopes=False)
    return around


def _significance(looking, sky, error):
    """Chi2 (N,) explained by each component, of all light but the sky's."""
    return (np.maximum(looking.signal_to_noise(sky, error), 0) ** 2).sum(axis=1)
