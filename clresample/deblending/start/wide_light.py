"""Finds light far wider than a source's profile: of a nucleus' faint host, of a listed point.

One smooth profile is either the nucleus or the host. Structure cannot add what is missing, since it
is in proportion to the profile: a host of half of a galaxy's light was lost at chi2 of 1. So a
galaxy whose surroundings hold light in the residuals of the profiles,

    gain = sum_c max(0, <w, r>)^2 / |w|^2,

w the whitened image of a wide profile at its place, gets that profile as its second component, and
all profiles are fitted again. Of several whose wide profiles overlap the one of the largest gain
has the light; the others are tested in what is then left.

A galaxy that is listed as a point leaves such light as well, if its neighbours do not take it: they
can grow, and had 4 times their flux, while it had 0.4 of its own. All profiles are fitted again
with a galaxy in its place, and if that is better, the changes are part of the fluxes' errors, and
a message names it. A true star among the arms of a galaxy may look so: it stays a point.
"""

from __future__ import annotations

import numpy as np

from ...sky.psf import SIGMAS_A_FWHM
from ..linear.equations import N_PARAMETERS
from ..linear.spectra import MODEL_ERROR
from .first_profiles import GROWTH, NEED, apart, products_beside

# Sigmas of wide profiles, in that of the sharpest PSF. Wider ones would take up what is left of the
# sky: 0.05 sigma a pixel within 9 times a PSF of 3.5 px gains 5.
WIDTHS = GROWTH, GROWTH**2
# Smallest ratio of such a profile to a galaxy's own, which has all narrower light.
MIN_RATIO = 2.0
# Smallest signal to noise of a galaxy that can have a host of its own.
MIN_SNR = 30.0


def wide_profiles(fit, candidates) -> dict:
    """Parameters of second components: {component: theta (4,)} of a ProfileFit that has ended.

    candidates (N,): bool, components whose source may have more than one; fit.looking is solved
    """
    chosen = np.flatnonzero(candidates & (_signal_to_noise(fit.looking) > MIN_SNR))
    around, listed, gain = _in_wide_light(fit, {i: fit.looking.components[i] for i in chosen})
    return dict(apart(around, listed, gain, _shown(fit, gain))) if listed else {}


def points_in_wide_light(fit, galaxies) -> list[int]:
    """Numbers of the stars with such light, of {component: StartComponent of a galaxy there}."""
    around, listed, gain = _in_wide_light(fit, galaxies)
    return sorted(i for i, _ in apart(around, listed, gain, _shown(fit, gain))) if listed else []


def _in_wide_light(fit, galaxies):
    """LinearisedScenes of wide profiles about {component: StartComponent}, [(i, theta)], gains."""
    looking, thetas = fit.looking, fit.thetas()
    listed = [(i, wide) for i, c in galaxies.items() for wide in _wider(looking, c, thetas[i])]
    if not listed:
        return looking, [], np.zeros(0)
    scenes = {int(looking.scene[i]) for i, _ in listed}
    models = {i: thetas[i] for i in np.flatnonzero(np.isin(looking.scene, list(scenes)))}
    components = [galaxies[i] for i, _ in listed]
    around, right, _, alone = products_beside(looking, models, listed, MODEL_ERROR, components)
    square = np.maximum(right, 0) ** 2
    gain = np.divide(square, alone, out=np.zeros_like(alone), where=alone > 0)
    gain = gain if looking.ties is None else gain[:, looking.ties.first]
    return around, listed, gain.sum(axis=1)


def _shown(fit, gain):
    """Places (k,) of gains (n,) that are significant."""
    return np.flatnonzero(gain > NEED + n_bands(fit.looking))


def n_bands(looking):
    """Number of bands, of which a second component has a flux each."""
    return looking.n_channels if looking.ties is None else looking.ties.n_bands


def _signal_to_noise(looking):
    """Of the components (N,), all channels together."""
    power = np.einsum("bcii->bic", looking.normal)[looking.scene, looking.index]
    return np.sqrt((looking.spectra**2 * power).sum(axis=1))


def _wider(looking, component, theta):
    """Parameters of round profiles about a StartComponent that are wider than one with theta.

    Those of stars, whose theta has no size, are any.
    """
    plans = [sight.views[component.scene].op.plans[0] for sight in looking.sights]
    widths = [p.psfs[1].fwhm_px.min() * abs(np.linalg.det(p.mapping.matrix)) ** 0.5 for p in plans]
    sizes = np.array(WIDTHS) * min(widths) / SIGMAS_A_FWHM
    own = np.exp(theta[0]) if len(theta) == N_PARAMETERS else 0.0
    sizes = sizes[(sizes > MIN_RATIO * own) & (2 * sizes < max(component.frame))]
    return [np.array([np.log(size), 0, 0, component.shape.mean[3]]) for size in sizes]
