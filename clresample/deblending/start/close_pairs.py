"""A further start of close pairs of galaxies, of which one may have the light of both.

Two galaxies that grow from small profiles at nearly one place compete for the same light: one may
grow to the size of both, while the other stays as small as it began. Chi2 has a minimum there, and
often a deeper one where each has its own light. To reach it, scenes are fitted again from the
larger one's profile at both places, without doubt of either shape, and the better fit stays. The
other one, worse in chi2 by Delta, has the weight w of an alternative that profiles, which are wrong
by more than noise, do not exclude. Errors of fluxes f hold the change to it (posterior.py):

    w = 1 / (1 + exp(Delta / NEED)),    scatter = sqrt(w) (f_other - f)
"""

from __future__ import annotations

import numpy as np

from ..profiles import GalaxyProfile, galaxy_reach
from .first_profiles import NEED
from .shape_grid import part_inside

# A close pair's largest distance, in units of the larger one's radius, and the least ratio of the
# two radii, where profiles fall to a part of their peak.
MAX_AWAY, MIN_RATIO, RADIUS_LEVEL = 0.5, 1.5, 0.1


def run_from_equal_profiles(fit, scenes):
    """Fits scenes (k,) of a ProfileFit again that hold close pairs; the better fits stay."""
    larger = {i: j for b in scenes for i, j in _larger_neighbours(fit, b)}
    if not larger:
        return
    at, thetas = np.array(fit.at), fit.thetas()
    scenes = np.unique(at[0, list(larger)])
    before, chi2, flux = fit._copy(), fit._chi2_as_expected(scenes), _fluxes(fit)
    for i, j in larger.items():
        fit.theta[*at[:, i]] = thetas[j]
        fit.population.contamination[*at[:, [i, j]]] = 1
    fit._take(scenes, doubt=False)
    fit._step(scenes)
    worse, change = fit._chi2_as_expected(scenes) - chi2, _fluxes(fit) - flux
    fit._undo(before, scenes[~(worse < 0)])
    weight = np.zeros(len(fit.chi2))
    weight[scenes] = 1 / (1 + np.exp(np.abs(worse) / NEED))
    fit.flux_doubt = np.sqrt(weight[at[0]])[:, None] * change


def _fluxes(fit):
    """Fluxes (N, C) of the components in their frames, in the views' units."""
    components = fit.looking.components
    galaxies = [i for i, c in enumerate(components) if isinstance(c.shape, GalaxyProfile)]
    out, thetas = fit.looking.spectra.copy(), fit.thetas()
    part = part_inside([components[i] for i in galaxies], np.array([thetas[i] for i in galaxies]))
    out[galaxies] *= part[:, None]
    return out


def _larger_neighbours(fit, b):
    """Pairs (component, the nearest larger one of its close pairs) in scene b."""
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
    away = np.where(size > MIN_RATIO * size[:, None], away, np.inf)
    nearest = away.argmin(axis=1)
    return [(at[k], at[j]) for k, j in enumerate(nearest) if away[k, j] < MAX_AWAY]
