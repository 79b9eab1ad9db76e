"""Finds galaxies with light far wider than their profile: a nucleus within a faint host.

One smooth profile is either the nucleus or the host. Structure cannot add what is missing, since it
is in proportion to the profile: a host of half of a galaxy's light was lost at chi2 of 1. So a
galaxy whose surroundings hold light in the residuals of the profiles,

    gain = sum_c max(0, <w, r>)^2 / |w|^2,

w the whitened image of a wide profile at its place, gets that profile as its second component, and
all profiles are fitted again. Of several whose wide profiles overlap the one of the largest gain
has the light; the others are tested in what is then left.
"""

from __future__ import annotations

import numpy as np

from ...sky.psf import SIGMAS_A_FWHM
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
    looking, thetas = fit.looking, fit.thetas()
    chosen = np.flatnonzero(candidates & (_signal_to_noise(looking) > MIN_SNR)).tolist()
    listed = [(i, wide) for i in chosen for wide in _wider(looking, i, thetas[i])]
    if not listed:
        return {}
    scenes = {int(looking.scene[i]) for i, _ in listed}
    models = {i: thetas[i] for i in np.flatnonzero(np.isin(looking.scene, list(scenes)))}
    around, right, _, alone = products_beside(looking, models, listed, MODEL_ERROR)
    square = np.maximum(right, 0) ** 2
    gain = np.divide(square, alone, out=np.zeros_like(alone), where=alone > 0)
    gain = (gain if looking.ties is None else gain[:, looking.ties.first]).sum(axis=1)
    shown = np.flatnonzero(gain > NEED + n_bands(looking))
    return dict(apart(around, listed, gain, shown))


def n_bands(looking):
    """Number of bands, of which a second component has a flux each."""
    return looking.n_channels if looking.ties is None else looking.ties.n_bands


def _signal_to_noise(looking):
    """Of the components (N,), all channels together."""
    power = np.einsum("bcii->bic", looking.normal)[looking.scene, looking.index]
    return np.sqrt((looking.spectra**2 * power).sum(axis=1))


def _wider(looking, i, theta):
    """Parameters of round profiles about a galaxy that are wider than it."""
    c = looking.components[i]
    plans = [sight.views[c.scene].op.plans[0] for sight in looking.sights]
    widths = [p.psfs[1].fwhm_px.min() * abs(np.linalg.det(p.mapping.matrix)) ** 0.5 for p in plans]
    sizes = np.array(WIDTHS) * min(widths) / SIGMAS_A_FWHM
    sizes = sizes[(sizes > MIN_RATIO * np.exp(theta[0])) & (2 * sizes < max(c.frame))]
    return [np.array([np.log(size), 0, 0, c.shape.mean[3]]) for size in sizes]
