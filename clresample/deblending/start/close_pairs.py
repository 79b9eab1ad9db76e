"""Further starts of close pairs of galaxies, of which one may have the light of both.

Two galaxies that grow from small profiles at nearly one place compete for the same light: one may
grow to the size of both, while the other stays as small as it began. Chi2 has a minimum there, and
often a deeper one where each has its own light, or one where they have exchanged their light. To
reach them, each pair is fitted again, without doubt of either shape, from the larger one's profile
at both places: both of them together, and with the smaller one's profile held there. All other
light stays as it is, so that pairs do not decide for one another. Scenes of which a pair has a
better end are fitted once more from there. Profiles are wrong by more than noise, so that errors of
the fluxes f hold the changes to the other ends, whose chi2 is worse by Delta (posterior.py):

    scatter = sqrt(w) (f_other - f),    w = 1 / (1 + exp(Delta / NEED))

"""

from __future__ import annotations

from itertools import zip_longest

import numpy as np
from scipy.special import expit

from ..profiles import GalaxyProfile, galaxy_reach
from .first_profiles import NEED
from .shape_grid import part_inside

# A close pair's largest distance, in units of the larger one's radius, and the smallest ratio of
# the two radii, at which profiles fall to this fraction of their peak. Of 120 galaxies in pairs
# none is silently wrong (bench.ladder, close, seed 52525); of 200 without further starts 18 are.
MAX_AWAY, MIN_RATIO, RADIUS_LEVEL = 0.5, 1.5, 0.1
N_ENDS = 3  # before, of both profiles, with one of them held


def run_from_equal_profiles(fit, scenes):
    """Fits close pairs in scenes (k,) of a ProfileFit again; the best end of each stays.

    Steps that end where they gain NEED cannot compare ends: fits of such a tolerance have no others.
    """
    groups = {b: _groups(_larger_neighbours(fit, b)) for b in scenes if fit.tol < NEED}
    scenes = np.array([b for b, own in groups.items() if own], int)
    if not len(scenes):
        return
    before, chi2, doubts, moved = fit._copy(), fit._chi2_as_expected(scenes), [], {}
    fit._look(scenes, fit.theta, slopes=False)
    rest = fit.looking.without_light(fit.looking.spectra)
    for some in zip_longest(*groups.values(), fillvalue={}):
        chosen, best, doubt = _best_ends(fit, rest, {i: j for own in some for i, j in own.items()})
        moved |= best
        doubts.append(np.zeros((*fit.looking.spectra.shape, N_ENDS)))
        doubts[-1][chosen] = doubt
    fit.flux_doubt = np.concatenate(doubts, axis=2)
    for i, (theta, spectrum) in moved.items():
        at = fit.looking.scene[i], fit.looking.index[i]
        fit.theta[at], fit.looking.spectra[i], fit.population.contamination[at] = theta, spectrum, 1
    again = np.unique(fit.looking.scene[list(moved)])
    fit._take(again, doubt=False)
    fit._step(again)
    better = fit._chi2_as_expected(scenes) < chi2
    fit._undo(before, np.intersect1d(again, scenes[~better]))


def _best_ends(fit, rest, larger):
    """Fits a group of close pairs in each of some scenes again, all other light held.

    larger: {component: that from which it starts}; rest: LinearisedScenes without the light of all
    returns the groups' components (n,); {component: (theta, spectrum)} of those with a better end;
        and the changes (n, C, N_ENDS) of their fluxes to the other ends
    """
    chosen = np.unique([*larger, *larger.values()])
    part = fit.part(rest, chosen)
    looking, at, scenes = part.looking, np.array(part.at), np.unique(part.at[0])
    small, other = (at[:, np.searchsorted(chosen, list(own))] for own in (larger, larger.values()))
    looking.spectra[:], looking.sky[:] = fit.looking.spectra[chosen], fit.looking.sky
    part._measure_brightness(part.theta)
    part._look(scenes, part.theta, slopes=False)
    part.looking = looking.without_light(-looking.spectra)  # adds their own to the rest
    part.chi2[scenes] = part._chi2(scenes, part.theta)
    before, begun, ends = part._copy(), part.theta[*other], [_end(part, scenes)]
    for held in (False, True):
        part._restore(before, scenes)
        part.theta[*small], part.moves[*small] = begun, not held
        part._take(scenes, doubt=False)
        part._step(scenes)
        ends.append(_end(part, scenes))
    chi2, theta, spectra, flux = (np.array(own) for own in zip(*ends, strict=True))
    best = np.argmin(chi2 - fit.tol * (np.arange(N_ENDS) == 0)[:, None], axis=0)
    weight, row = expit((chi2.min(axis=0) - chi2) / NEED), np.searchsorted(scenes, at[0])
    n = np.arange(len(chosen))
    best, change = best[row], flux - flux[best[row], n]
    moved = {i: (theta[best[k], k], spectra[best[k], k]) for k, i in enumerate(chosen) if best[k]}
    return chosen, moved, np.moveaxis(np.sqrt(weight[:, row])[..., None] * change, 0, -1)


def _end(part, scenes):
    """Chi2 (k,) of scenes, and theta (n, 4), spectra and fluxes (n, C) of all components of these."""
    theta, spectra = part.theta[*part.at], part.looking.spectra.copy()
    inside = part_inside(part.looking.components, theta)
    return part._chi2_as_expected(scenes), theta, spectra, spectra * inside[:, None]


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
    radius = galaxy_reach(np.array([theta[i] for i in at]), moments, np.full(len(at), RADIUS_LEVEL))
    place = np.array([components[i].position for i in at])
    away = np.linalg.norm((place[:, None] - place) / radius, axis=2)  # of the second one's radii
    size = np.sqrt(radius.prod(axis=1))
    doubt = fit.population.contamination[*np.array(fit.at)[:, at]]
    poorer = (doubt[:, None] > NEED) & (doubt[:, None] > doubt)
    away = np.where((size > MIN_RATIO * size[:, None]) | poorer, away, np.inf)
    np.fill_diagonal(away, np.inf)
    nearest = away.argmin(axis=1)
    return [(at[k], at[j]) for k, j in enumerate(nearest) if away[k, j] < MAX_AWAY]
