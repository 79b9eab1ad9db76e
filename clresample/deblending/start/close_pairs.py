"""Further starts of close pairs of galaxies, of which one may have the light of both.

Two galaxies that grow from small profiles at nearly one place compete for the same light: one may
grow to the size of both, while the other stays as small as it began. Chi2 has a minimum there, and
often a deeper one where each has its own light, or one where they have exchanged their light. To
reach them, scenes are fitted again, without doubt of either shape, from the larger one's profile at
both places: all of them together, and with the smaller one's profile held there. The best end
stays. Profiles are wrong by more than noise, so that errors of the fluxes f hold the changes to the
other ends, whose chi2 is worse by Delta (posterior.py):

    scatter = sqrt(w) (f_other - f),    w = 1 / (1 + exp(Delta / NEED))

"""

from __future__ import annotations

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
    """Fits scenes (k,) of a ProfileFit again that hold close pairs; the best ends stay."""
    larger = {i: j for b in scenes for i, j in _larger_neighbours(fit, b)}
    if not larger:
        return
    at, small, thetas = np.array(fit.at), list(larger), fit.thetas()
    scenes, before = np.unique(at[0, small]), fit._copy()
    ends = [(before, *_end(fit, scenes))]
    for held in (False, True):
        fit._restore(before, scenes)
        for i, j in larger.items():
            fit.theta[*at[:, i]] = thetas[j]
            fit.population.contamination[*at[:, [i, j]]] = 1
        fit.moves[*at[:, small]] = not held
        fit._take(scenes, doubt=False)
        fit._step(scenes)
        ends.append((fit._copy(), *_end(fit, scenes)))
    fit.moves[*at[:, small]] = True
    copies, chi2, flux = zip(*ends, strict=True)
    chi2, best = np.array(chi2), np.zeros(len(fit.chi2), int)
    best[scenes] = chi2.argmin(axis=0)
    for k, copy in enumerate(copies):
        fit._undo(copy, scenes[best[scenes] == k])
    weight = np.zeros((N_ENDS, len(fit.chi2)))
    weight[:, scenes] = expit((chi2.min(axis=0) - chi2) / NEED)
    change = flux - np.array(flux)[best[at[0]], np.arange(len(at[0]))]
    fit.flux_doubt = np.moveaxis(np.sqrt(weight[:, at[0]])[..., None] * change, 0, -1)


def _end(fit, scenes):
    """Chi2 (k,) of some scenes and fluxes (N, C) of all components, in the views' units."""
    return fit._chi2_as_expected(scenes), _fluxes(fit)


def _fluxes(fit):
    """Fluxes (N, C) of the components in their frames, in the views' units."""
    components = fit.looking.components
    galaxies = [i for i, c in enumerate(components) if isinstance(c.shape, GalaxyProfile)]
    out, thetas = fit.looking.spectra.copy(), fit.thetas()
    part = part_inside([components[i] for i in galaxies], np.array([thetas[i] for i in galaxies]))
    out[galaxies] *= part[:, None]
    return out


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
