"""Further starts of close pairs of galaxies, of which one may have the light of both.

Two galaxies that grow from small profiles at nearly one place compete for the same light: one may
grow to the size of both, while the other stays as small as it began. Chi2 has a minimum there, and
often a deeper one where each has its own light, or one where they have exchanged their light. To
reach them, each pair is fitted again, without doubt of either shape, from the larger one's profile
at both places, both of them together and with the smaller one's profile held there, and from the
two profiles exchanged: a compact galaxy within a wide one may have grown to the size of that, with
a cusp of its own light. All other light stays as it is, so that pairs do not decide for one
another. Scenes of which a pair has a better end are fitted once more from there. Profiles are wrong
by more than noise, so that errors of the fluxes f hold the changes to the other ends, whose chi2 is
worse by Delta (posterior.py):

    scatter = sqrt(w) (f_other - f),    w = 1 / (1 + exp(Delta / NEED))

"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from ..linear.spectra import portions
from ..profiles import GalaxyProfile, covariance
from .first_profiles import NEED
from .shape_grid import part_inside

# A close pair's largest distance, in units of the larger one's radius, the root of C, and the
# smallest ratio of the two radii. Of 120 galaxies in pairs none is silently wrong (bench.ladder,
# close, seed 52525); of 200 without further starts 18 are.
MAX_AWAY, MIN_RATIO = 1.1, 1.5
N_ENDS = 4  # before, of both profiles, with one of them held, with both exchanged
# Side of the windows in which pairs are fitted, in that of their light before, which may widen.
MARGIN = 1.5
BYTES_A_PIXEL = 20  # of root, data, light, residual and weight


def run_from_equal_profiles(fit, scenes):
    """Fits close pairs in scenes (k,) of a ProfileFit again; the best end of each stays.

    Fits with a tolerance of NEED or more are left as they are: their ends differ by as much.
    """
    groups = [g for b in scenes if fit.tol < NEED for g in _groups(_larger_neighbours(fit, b))]
    if not groups:
        return
    scenes = np.unique([fit.looking.scene[min(own)] for own in groups])
    before, chi2, moved = fit._copy(), fit.chi2_as_expected(scenes), []
    fit._look(scenes, fit.theta, slopes=False)
    rest = fit.looking.without_light(fit.looking.spectra)
    windows = [_windows(fit.looking, sight, groups) for sight in rest.sights]
    doubt = np.zeros((*fit.looking.spectra.shape, N_ENDS * len(groups)))
    pairs = zip(rest.sights, windows, strict=True)
    n_pixels = sum(sight.n_bands * int(np.prod(size)) for sight, (_, size) in pairs)
    for some in portions(len(groups), N_ENDS * BYTES_A_PIXEL * n_pixels):
        cuts = [(np.tile(low[some], (N_ENDS, 1)), size) for low, size in windows]
        columns = doubt[..., N_ENDS * some.start : N_ENDS * some.stop]
        moved += _best_ends(fit, rest, groups[some], cuts, columns)
    fit.flux_doubt = np.concatenate([fit.flux_doubt, doubt], axis=2)
    fit.population.contamination[*np.array(fit.at)[:, moved]] = 1
    again = np.unique(fit.looking.scene[moved])
    fit._take(again, doubt=False)
    fit._step(again)
    better = fit.chi2_as_expected(scenes) < chi2
    fit._restore(before, np.intersect1d(again, scenes[~better]))


def _best_ends(fit, rest, groups, windows, doubt):
    """Fits close pairs to their best ends, all other light held; the components (k,) that moved.

    rest: LinearisedScenes without any light; windows: of the groups in each observation
    doubt (N, C, N_ENDS * n_groups): filled with the changes of fluxes to the other ends
    """
    members = [(g, i) for g, own in enumerate(groups) for i in sorted({*own, *own.values()})]
    group, chosen = np.array(members).T
    n_all, scene = len(chosen), fit.looking.scene[chosen]
    of_group = scene[np.searchsorted(group, np.arange(len(groups)))]
    at_end = np.arange(N_ENDS)[:, None] * len(groups) + group
    each, scenes = np.tile(chosen, N_ENDS), np.tile(of_group, N_ENDS)
    looking = rest.cut(at_end.ravel(), each, scenes, windows)
    part = fit.part(looking, each, fit.noise[scenes])
    looking.spectra[:] = fit.looking.spectra[each]
    every = np.arange(looking.n_scenes)
    part._measure_brightness(part.theta)
    part._look(every, part.theta, slopes=False)
    part.looking = looking.without_light(-looking.spectra)  # adds their own to the rest
    at = np.reshape(part.at, (2, N_ENDS, n_all))
    small = np.array([i in groups[g] for g, i in members])
    larger = np.array([members.index((g, groups[g][i])) for g, i in members if i in groups[g]])
    part.theta[*at[:, 1:-1, small]] = part.theta[*at[:, 1:-1, larger]]
    part.moves[*at[:, 2, small]] = False
    found = _exchanged(fit.looking.components, groups, members)
    pairs = np.array(found, int).reshape(-1, 2)
    part.theta[*at[:, -1, pairs]] = part.theta[*at[:, -1, pairs[:, ::-1]]]
    part._take(every, doubt=False)
    part._step(every[len(groups) :])
    chi2 = part.chi2_as_expected(every).reshape(N_ENDS, -1)
    theta, spectra = part.theta[*at], part.looking.spectra.reshape(N_ENDS, n_all, -1)
    inside = part_inside(looking.components, theta.reshape(N_ENDS * n_all, -1))
    flux = spectra * inside.reshape(N_ENDS, n_all, 1)
    best = np.argmin(chi2 - fit.tol * (np.arange(N_ENDS) == 0)[:, None], axis=0)[group]
    weight, here = expit((chi2.min(axis=0) - chi2) / NEED), (best, np.arange(n_all))
    change = np.sqrt(weight[:, group])[..., None] * (flux - flux[here])
    for k in range(N_ENDS):
        doubt[chosen, :, N_ENDS * group + k] = change[k]
    moved = best > 0
    fit.theta[*np.array(fit.at)[:, chosen[moved]]] = theta[here][moved]
    fit.looking.spectra[chosen[moved]] = spectra[here][moved]
    return chosen[moved].tolist()


def _exchanged(components, groups, members):
    """Places (k, 2) among `members` of the pairs of groups that exchange their profiles.

    A larger one exchanges with the nearest of its smaller ones, if it is no smaller one itself.
    """
    nearest: dict = {}
    for k, (g, i) in enumerate(members):
        j = groups[g].get(i)
        if j is None or j in groups[g]:
            continue
        away = np.hypot(*np.subtract(components[i].position, components[j].position))
        one = away, k, members.index((g, j))
        nearest[g, j] = min(nearest.get((g, j), one), one)
    return [pair for _, *pair in nearest.values()]


def _windows(looking, sight, groups):
    """First pixels (k, 2) and size (2,) of windows about the light of groups in an observation."""
    shape, low, high = np.array([sight.my, sight.mx]), [], []
    lit = np.zeros((len(looking.components), 4), int)
    lit[looking.at] = sight.lit
    for own in groups:
        each = lit[[*own, *own.values()]]
        low.append(each[:, :2].min(axis=0))
        high.append((each[:, :2] + each[:, 2:]).max(axis=0))
    low, high = np.clip(low, 0, shape), np.clip(high, 0, shape)
    size = np.clip((MARGIN * (high - low).max(axis=0)).astype(int), 1, shape)
    return np.clip((low + high - size) // 2, 0, shape - size), size


def _groups(pairs):
    """Pairs (component, larger one) as dicts of those that share components."""
    groups: list[dict] = []
    for i, j in pairs:
        joined = [own for own in groups if {i, j} & {*own, *own.values()}]
        groups = [own for own in groups if own not in joined]
        groups.append({i: j} | {k: v for own in joined for k, v in own.items()})
    return groups


def _larger_neighbours(fit, b):
    """Pairs (component, the nearest one that may have its light) in scene b.

    That is a larger one, or, since a profile takes light with its wings too, any if the light of
    others about the component is significant, and less so about that one.
    """
    components, theta = fit.looking.components, fit.thetas()
    at = [
        i
        for i in np.flatnonzero(fit.looking.scene == b)
        if isinstance(components[i].shape, GalaxyProfile) and components[i].shape.whole
    ]
    if len(at) < 2:
        return []
    moments = np.array([components[i].shape.psf_moment for i in at])
    c = covariance(np.array([theta[i] for i in at]), moments)[0]
    radius = np.sqrt(np.diagonal(c, axis1=1, axis2=2))
    place = np.array([components[i].position for i in at])
    away = np.linalg.norm((place[:, None] - place) / radius, axis=2)  # of the second one's radii
    size = np.sqrt(radius.prod(axis=1))
    doubt = fit.population.contamination[*np.array(fit.at)[:, at]]
    poorer = (doubt[:, None] > NEED) & (doubt[:, None] > doubt)
    away = np.where((size > MIN_RATIO * size[:, None]) | poorer, away, np.inf)
    np.fill_diagonal(away, np.inf)
    nearest = away.argmin(axis=1)
    return [(at[k], at[j]) for k, j in enumerate(nearest) if away[k, j] < MAX_AWAY]
