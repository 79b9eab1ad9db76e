"""Further starts without doubt of shapes, of scenes in which that doubt may hold one of them.

If one of two similar galaxies has the other one's light, that one's shape is contaminated
(population.py); so is a disk between two galaxies on its major axis, which then stays round while
they have its ends. Such scenes are fitted again without doubt. Errors of fluxes hold the changes to
the ends that do not stay, as those of close_pairs.py.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from ..profiles import covariance
from .first_profiles import NEED, begin_with_large_galaxies
from .shape_grid import part_inside
from .step_control import StepControl

# Smallest gain in chi2 that a step without doubt promises, for a fit without it.
MIN_GAIN = 12.0
# Smallest correlation of the images of two galaxies that may have each other's light, and distance
# of one from the middle of all such light, in units of the size of that.
MIN_ALIKE, MAX_ASIDE = 0.003, 0.3
# Smallest signal to noise of a galaxy whose shape is freed, in that of one it overlaps: a fainter
# one may follow the arms of that.
MIN_BRIGHT = 0.2


def run_without_doubt(fit, scenes, *, again=False):
    """Fits scenes of a ProfileFit again without contamination of their shapes.

    Scenes in which that may gain NEED are fitted from where they are. The best end stays if it
    gains 2 NEED and E^2, as much as errors of the neighbours' models may feign (population.py):
    below that structure decides. Galaxies far fainter than others stay doubted.

    again: if they may gain MIN_GAIN, and with two more starts: from galaxies that have the light of
        those about them, and from profiles of large galaxies, as scenes of large ones begin
    """
    if not len(scenes):
        return
    contamination = fit.population.contamination[scenes]
    doubted = np.where(_is_bright(fit, scenes), 1, contamination)
    fit.population.contamination[scenes] = doubted
    given = *fit._equations(scenes), fit.population.galaxies[scenes]
    may_gain = StepControl(len(fit.theta)).next(scenes, *given)[1] > (MIN_GAIN if again else NEED)
    fit.population.contamination[scenes] = contamination
    if not may_gain.any():
        return
    scenes, doubted = scenes[may_gain], doubted[may_gain]
    feigned = (contamination[may_gain] - doubted).max(axis=1)
    before, here = fit._copy(), fit.chi2_as_expected(scenes)
    ends, best, lowest = [(here, _fluxes(fit))], before, np.full(len(scenes), np.inf)
    begins = (_begin_with_merged_galaxies, begin_with_large_galaxies) if again else ()
    for begin in (None, *begins):
        fit._restore(before, scenes)
        if begin is not None:
            begin(fit, scenes)
        fit.population.contamination[scenes] = doubted
        fit._take(scenes, doubt=False)
        fit._step(scenes)
        chi2 = fit.chi2_as_expected(scenes)
        ends.append((chi2, _fluxes(fit)))
        fit._undo(best, scenes[chi2 >= lowest])
        best, lowest = fit._copy(), np.minimum(chi2, lowest)
    stays = here - lowest > 2 * NEED + feigned
    fit._undo(before, scenes[~stays])
    flux, kept, weight = _fluxes(fit), np.where(stays, lowest, here), np.zeros(len(fit.theta))
    doubt = np.zeros((*flux.shape, len(ends)))
    for k, (chi2, other) in enumerate(ends):
        weight[scenes] = expit((kept - chi2) / NEED)
        doubt[..., k] = np.sqrt(weight[fit.looking.scene])[:, None] * (other - flux)
    fit.flux_doubt = np.concatenate([fit.flux_doubt, doubt], axis=2)


def _overlaps(fit, b):
    """Galaxies (n,) of scene b, which of them overlap (n, n), and their signal to noise (n,).

    As Gaussians of their second moments, under the model's PSF, in their best channels.
    """
    own = np.flatnonzero((fit.looking.scene == b) & fit.expected.galaxies[fit.at])
    components = [fit.looking.components[i] for i in own]
    moments = np.array([c.shape.psf_moment for c in components]).reshape(-1, 2, 2)
    c = covariance(fit.theta[b, fit.looking.index[own]], moments)[0]
    place, area = np.array([x.position for x in components]).reshape(-1, 2), _root_det(c)
    away, both = place - place[:, None], c + c[:, None]
    far = np.einsum("ijk,ijkl,ijl->ij", away, np.linalg.inv(both), away)
    alike = 2 * np.sqrt(np.outer(area, area)) / _root_det(both) * np.exp(-far / 2)
    return own, alike > MIN_ALIKE, fit.brightness[own] * np.sqrt(4 * np.pi * area)


def _root_det(matrices):
    return np.sqrt(np.linalg.det(matrices))


def _is_bright(fit, scenes):
    """Selects galaxies (k, n) of scenes (k,) that are not far fainter than those they overlap."""
    found = np.zeros((len(scenes), fit.theta.shape[1]), bool)
    for row, b in zip(found, scenes, strict=True):
        own, alike, snr = _overlaps(fit, b)
        row[fit.looking.index[own]] = snr > MIN_BRIGHT * np.where(alike, snr, 0).max(1, initial=0)
    return found


def _begin_with_merged_galaxies(fit, scenes):
    """Sets profiles in scenes (k,) of galaxies in the middle of others: with the light of these.

    The others begin as expected.
    """
    looking = fit.looking
    for b in scenes:
        own, alike, _ = _overlaps(fit, b)
        index = looking.index[own]
        place = np.array([looking.components[i].position for i in own]).reshape(-1, 2)
        theta = fit.theta[b, index]
        light = (looking.spectra[own] / fit.noise[b]).sum(axis=1) * alike
        light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-300)  # (n, n)
        away = place - place[:, None]
        aside = np.linalg.norm(np.einsum("ij,ijk->ik", light, away), axis=1)
        moment = covariance(theta, 0.0)[0] + np.einsum("ijk,ijl->ijkl", away, away)
        moment = np.einsum("ij,ijkl->ikl", light, moment)
        size = np.trace(moment, axis1=1, axis2=2) / 2
        middle = ((light > 0).sum(axis=1) > 2) & (aside < MAX_ASIDE * np.sqrt(size))
        for i in np.flatnonzero(middle)[np.argsort(aside[middle])]:
            if not middle[i]:
                continue
            beside = light[i] > 0
            middle[beside] = False
            (yy, xy), (_, xx) = moment[i]
            e = np.array([(yy - xx) / 2, xy]) / size[i]
            fit.theta[b, index[beside]] = fit.expected.mean[b, index[beside]]
            fit.theta[b, index[i], :3] = 0.5 * np.log(size[i]), *(e / np.sqrt(1 - min(e @ e, 0.9)))


def _fluxes(fit):
    """Fluxes (N, C) of the components of a ProfileFit inside their frames."""
    inside, at = np.ones(len(fit.counts)), np.flatnonzero(fit.expected.galaxies[fit.at])
    components = [fit.looking.components[i] for i in at]
    inside[at] = part_inside(components, fit.theta[fit.at][at])
    return fit.looking.spectra * inside[:, None]
