"""Finds light that a source's one profile leaves: of a faint host, of a core of another colour.

One smooth profile is either the nucleus or the host. Structure cannot add what is missing, since it
is in proportion to the profile: a host of half of a galaxy's light was lost at chi2 of 1. So a
galaxy whose surroundings hold light in the residuals of the profiles, in which a wide one has a
significant gain (alternatives.py), gets that profile as its second component, and all profiles are
fitted again. Of several whose wide profiles overlap the one of the largest gain has the light; the
others are tested in what is then left.

One profile of a galaxy whose core has another colour may be wrong by more than
NEIGHBOUR_MODEL_ERROR in some bands, and faint sources about it grow into what it leaves: one of
signal to noise 1800 had 0.37 of its flux in one band. If the core is resolved in all images, a
narrower profile with the whitened image u has the gain of another colour than its spectrum A,

    sum_c <u, r>^2 / |u|^2 - (sum_c A <u, r>)^2 / sum_c A^2 |u|^2,

r the residuals, with the errors of other models, less the same of its own profile.

A galaxy that is listed as a point leaves such light as well, if its neighbours do not take it: they
can grow, and had 4 times their flux, while it had 0.4 of its own. All profiles are fitted again
with a galaxy in its place, and if that is better, the changes are part of the fluxes' errors, and
a message names it. A true star among the arms of a galaxy may look so: it stays a point.
"""

from __future__ import annotations

import numpy as np

from ...sky.psf import SIGMAS_A_FWHM
from ..linear.equations import N_PARAMETERS
from .alternatives import Alternatives
from .first_profiles import GROWTH, NEED, apart

# Sigmas of wide profiles, in that of the sharpest PSF. Wider ones would take up what is left of the
# sky: 0.05 sigma a pixel within 9 times a PSF of 3.5 px gains 5.
WIDTHS = GROWTH, GROWTH**2
# Smallest ratio of such a profile to a galaxy's own, which has all narrower light.
MIN_RATIO = 2.0
# Smallest signal to noise of a galaxy that can have a host of its own.
MIN_SNR = 30.0


def second_profiles(fit, candidates) -> dict:
    """Parameters of second components: {component: theta (4,)} of a ProfileFit that has ended.

    candidates (N,): bool, components whose source may have more than one; fit.looking is solved
    """
    chosen = np.flatnonzero(candidates & (_signal_to_noise(fit.looking) > MIN_SNR))
    galaxies = {i: fit.looking.components[i] for i in chosen}
    return _significant(fit, galaxies, (_wider, _narrower), Alternatives.certain_gain)


def points_in_wide_light(fit, galaxies) -> list[int]:
    """Numbers of the stars with such light, of {component: StartComponent of a galaxy there}."""
    return sorted(_significant(fit, galaxies, (_wider,), Alternatives.full_gain))


def _significant(fit, galaxies, kinds, gain_of):
    """Profiles {component: theta} of significant gains, which do not overlap.

    galaxies: {component: StartComponent of a galaxy}; kinds: functions that give profiles of it
    gain_of: the function that gives the gains of wider ones
    """
    thetas, own = fit.thetas(), {}
    for i, c in galaxies.items():
        others = [theta for kind in kinds for theta in kind(fit.looking, c, thetas[i])]
        if others:
            own[i] = [thetas[i], *others]
    if not own:
        return {}
    fit.solve_shapes(np.unique(fit.looking.scene[list(own)]))
    found = Alternatives(fit, own, galaxies, faint=False)
    products = found.tied(found.right - found.explained), found.tied(found.alone)
    colour = found.colour_gain(*products, fit.looking.spectra[found.component])
    sizes = np.array([_ln_sigma(theta) for theta in found.theta])
    narrower = sizes < sizes[found.first][found.owner]
    of_present = colour[found.first][found.owner]
    gain = np.where(narrower, colour - of_present, gain_of(found, *products))
    gain[found.first] = 0
    shown = np.flatnonzero(gain > NEED + n_bands(fit.looking))
    listed = list(zip(found.component.tolist(), found.theta, strict=True))
    return dict(apart(found.around, listed, gain, shown))


def n_bands(looking):
    """Number of bands, of which a second component has a flux each."""
    return looking.n_channels if looking.ties is None else looking.ties.n_bands


def _signal_to_noise(looking):
    """Of the components (N,), all channels together."""
    power = np.einsum("bcii->bic", looking.normal)[looking.scene, looking.index]
    return np.sqrt((looking.spectra**2 * power).sum(axis=1))


def _ln_sigma(theta):
    """Of a galaxy's parameters; those of a star, which are fewer, have none."""
    return theta[0] if len(theta) == N_PARAMETERS else -np.inf


def _psf_sigmas(looking, component, widest=False):
    """Sigmas [px] of the sharpest, or widest, PSF of each observation of a component's scene."""
    plans = [sight.views[component.scene].op.plans[0] for sight in looking.sights]
    scale = np.sqrt([abs(np.linalg.det(plan.mapping.matrix)) for plan in plans])
    of = np.max if widest else np.min
    return scale * [of(plan.psfs[1].fwhm_px) for plan in plans] / SIGMAS_A_FWHM


def _wider(looking, component, theta):
    """Parameters of round profiles about a StartComponent that are wider than one with theta."""
    sizes = np.array(WIDTHS) * _psf_sigmas(looking, component).min()
    own = np.exp(_ln_sigma(theta))
    sizes = sizes[(sizes > MIN_RATIO * own) & (2 * sizes < max(component.frame))]
    return [np.array([np.log(size), 0, 0, component.shape.mean[3]]) for size in sizes]


def _narrower(looking, component, theta):
    """Those of one that is narrower, if all of several bands resolve it."""
    core = theta[0] - np.log(GROWTH)
    resolved = np.exp(core) > _psf_sigmas(looking, component, widest=True).max()
    found = [np.array([core, *theta[1:3], component.shape.mean[3]])]
    return found if resolved and n_bands(looking) > 1 else []
