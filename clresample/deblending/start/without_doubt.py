"""Further starts without doubt of shapes, where that doubt or neighbours may hold one of them.

If one of two similar galaxies has the other one's light, that one's shape is contaminated
(population.py), and the scene is fitted again without doubt. A disk between two galaxies on its
major axis stays round while they have its ends: its scene is fitted again from where it has all
light of the three. Errors of fluxes hold the changes to the ends that do not stay, as those of
close_pairs.py.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from ..profiles import covariance
from .first_profiles import NEED
from .shape_grid import part_inside
from .step_control import StepControl

# Smallest gain in chi2 that a step without doubt promises, for a fit without it.
MIN_GAIN = 12.0
# Smallest correlation of the images of two galaxies that may have each other's light, and distance
# of one from the middle of all such light, in units of the size of that.
MIN_ALIKE, MAX_ASIDE = 0.003, 0.3
# Smallest signal to noise of a galaxy whose shape is freed, in that of one it overlaps: fainter
# ones follow its bar or arms, of a tenth of its light. With 0, one of signal to noise 2659 had 0.64
# of its flux, and one of 49 the rest; with 0.2, disks between two galaxies stay round.
MIN_BRIGHT = 0.05
# Smallest gain in chi2 of the best end, beside what errors of the neighbours' models may feign.
# With half of it, the largest E^2 in place of the sum, and all shapes freed, two of 88 scenes of
# COSMOS galaxies lose 3 to 7 dB in several of them.
MIN_BETTER = 4 * NEED
# Largest number of components of a scene of small galaxies that is fitted again, and of any scene
# with galaxies between others: ends are compared for whole scenes, and fitting 300 sources again
# took a third of their start for nothing.
MAX_FREED = 30


def run_without_doubt(fit, scenes, large):
    """Fits some of the scenes (k,) of a ProfileFit again without contamination of their shapes.

    Scenes in which a step may gain MIN_GAIN are fitted from where they are, and those with galaxies
    between others from where the galaxies between have all the light (MAX_FREED). The best end
    stays if it gains MIN_BETTER and the sum of E^2, as much as errors of the neighbours' models may
    feign (population.py): below that structure decides. Shapes of scenes that stay are free until
    the start ends. Galaxies far fainter than others stay doubted.

    large: the numbers of those that may hold large galaxies; of others those with an earlier fit
        are left out
    """
    few = (fit.source[scenes] >= 0).sum(axis=1) <= MAX_FREED
    few, scenes = (a[(few & ~fit.is_known[scenes]) | np.isin(scenes, large)] for a in (few, scenes))
    if not len(scenes):
        return
    contamination = fit.population.contamination[scenes]
    doubted = np.where(_is_faint(fit, scenes), contamination, 1)
    fit.set_contamination(scenes, doubted)
    given = *fit._equations(scenes), fit.population.galaxies[scenes]
    frees = StepControl(len(fit.theta)).next(scenes, *given)[1] > MIN_GAIN
    frees &= (contamination > doubted).any(axis=1)
    fit.set_contamination(scenes, contamination)
    merged = {b: theta for b in scenes[few] if (theta := _merged(fit, b)) is not None}
    merges = np.isin(scenes, list(merged))
    given = scenes, frees, merges, doubted, (contamination - doubted).sum(axis=1)
    scenes, frees, merges, doubted, feigned = (values[frees | merges] for values in given)
    if not len(scenes):
        return
    before, here = fit._copy(), fit.chi2_as_expected(scenes)
    ends, best, lowest = [(here, _fluxes(fit))], before, np.full(len(scenes), np.inf)
    for some, begun in ((frees, {}), (merges, merged)):
        fit._restore(before, scenes)
        fit.set_contamination(scenes, doubted)
        for b, theta in begun.items():
            fit.theta[b] = theta
        fit._take(np.array(list(begun), int), doubt=False)
        fit._step(scenes[some])
        chi2 = np.where(some, fit.chi2_as_expected(scenes), np.inf)
        ends.append((chi2, _fluxes(fit)))
        fit._restore(best, scenes[chi2 >= lowest])
        best, lowest = fit._copy(), np.minimum(chi2, lowest)
    stays = here - lowest > MIN_BETTER + feigned
    fit._restore(before, scenes[~stays])
    flux, kept, weight = _fluxes(fit), np.where(stays, lowest, here), np.zeros(len(fit.theta))
    doubt = np.zeros((*flux.shape, len(ends)))
    for k, (chi2, other) in enumerate(ends):
        weight[scenes] = expit((kept - chi2) / NEED)
        doubt[..., k] = np.sqrt(weight[fit.looking.scene])[:, None] * (other - flux)
    fit.flux_doubt = np.concatenate([fit.flux_doubt, doubt], axis=2)


def _merged(fit, b):
    """Parameters (n, 4) of scene b, its galaxies between others with the light of these, or None.

    The others begin as expected.
    """
    own, away, overlap, _ = _overlaps(fit, b)
    index, found = fit.looking.index[own], fit.theta[b].copy()
    theta = found[index]
    light = (fit.looking.spectra[own] / fit.noise[b]).sum(axis=1) * overlap
    beside = (light > 0) & (fit.source[b, index][:, None] != fit.source[b, index])
    light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-300)  # (n, n)
    aside = np.linalg.norm(np.einsum("ij,ijk->ik", light, away), axis=1)
    moment = covariance(theta, 0.0)[0] + np.einsum("ijk,ijl->ijkl", away, away)
    moment = np.einsum("ij,ijkl->ikl", light, moment)
    size = np.trace(moment, axis1=1, axis2=2) / 2
    middle = (beside.sum(axis=1) > 1) & (aside < MAX_ASIDE * np.sqrt(size))
    if not middle.any():
        return None
    for i in np.flatnonzero(middle)[np.argsort(aside[middle])]:
        if not middle[i]:
            continue
        middle[beside[i]] = False
        (yy, xy), (_, xx) = moment[i]
        e = np.array([(yy - xx) / 2, xy]) / size[i]
        found[index[beside[i]]] = fit.expected.mean[b, index[beside[i]]]
        found[index[i], :3] = 0.5 * np.log(size[i]), *(e / np.sqrt(1 - min(e @ e, 0.9)))
    return found


def _galaxies(fit):
    """Selects components (N,) that are galaxies."""
    return fit.expected.galaxies[fit.at]


def _overlaps(fit, b):
    """Galaxies (n,) of scene b, their distances (n, n, 2) [px], and which may share light (n, n).

    As Gaussians of their second moments, under the model's PSF. Last, their signal to noise (n,) in
    their best channels.
    """
    own = np.flatnonzero((fit.looking.scene == b) & _galaxies(fit))
    components = [fit.looking.components[i] for i in own]
    place = np.array([c.position for c in components]).reshape(-1, 2)
    moments = np.array([c.shape.psf_moment for c in components]).reshape(-1, 2, 2)
    c = covariance(fit.theta[fit.at][own], moments)[0]
    away, area, both = place - place[:, None], np.linalg.det(c) ** 0.25, c + c[:, None]
    far = np.einsum("ijk,ijkl,ijl->ij", away, np.linalg.inv(both), away)
    alike = 2 * np.outer(area, area) / np.sqrt(np.linalg.det(both)) * np.exp(-far / 2)
    return own, away, alike > MIN_ALIKE, fit.brightness[own] * np.sqrt(4 * np.pi) * area


def _is_faint(fit, scenes):
    """Selects galaxies (k, n) of scenes (k,) that are far fainter than one they overlap."""
    found = np.zeros((len(scenes), fit.theta.shape[1]), bool)
    for row, b in zip(found, scenes, strict=True):
        own, _, overlap, snr = _overlaps(fit, b)
        row[fit.looking.index[own]] = snr < MIN_BRIGHT * np.where(overlap, snr, 0).max(1, initial=0)
    return found


def _fluxes(fit):
    """Fluxes (N, C) of the components of a ProfileFit inside their frames."""
    inside, at = np.ones(len(fit.counts)), np.flatnonzero(_galaxies(fit))
    components = [fit.looking.components[i] for i in at]
    inside[at] = part_inside(components, fit.theta[fit.at][at])
    return fit.looking.spectra * inside[:, None]
