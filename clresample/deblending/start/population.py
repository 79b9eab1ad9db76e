"""Prior on the sizes and wings of a scene's galaxies, updated by EM from the same galaxies.

A galaxy's ln sigma and ln beta, its size and the width of its wings, follow

    theta_i = mean_i + c + s x_i,    c ~ N(0, SCENE_SCATTER^2),    x_i ~ Student's t of STUDENT_DOF

with c and s common to the scene, and its ellipticity e = g / sqrt(1 + g^2), of variance v,

    (1 - a) N(g; v) + a / (pi (1 + g^2)^2),    a = ANY_SHAPE,

which is round, or any e of |e| < 1 with equal density. Faint galaxies are then similar to the
others of their scene. A galaxy unlike all others, a bright spiral among faint ones, has little
weight. Both c and s are updated by a step of expectation and maximisation (Dempster, Laird & Rubin
1977, J. R. Stat. Soc. B 39, 1) after each step of the fit. With

    f_i = 1 / (1 + v_i / s^2),    v_i the variance of theta_i of the data alone,

the step has the factor f_i / max f for a galaxy, and its square for s: a faint galaxy beside better
known ones, which is as the prior expects, neither keeps c and s where they are nor changes them.

Errors in the models of neighbours can mimic the shape of a galaxy. Real galaxies differ from smooth
profiles by a tenth of their light and more, with correlated differences over many pixels. The
weights of the start (spectra.MODEL_ERROR) count that as independent noise of each pixel, which
nearly cancels over a whole galaxy. With u a galaxy's whitened image, all channels in one, and M
that of all other sources, an error in M changes the light of u by

    E = NEIGHBOUR_MODEL_ERROR max(0, <u, M> - OWN_LIGHT alike <u, u>) / |u|

in units of its error, so that the variance of its shape is 1 + E^2 times that of the data alone.
The channels in which its neighbours have the least of its light may say more without the others:
the least of (1 + E^2) |u|^2 / |u'|^2 counts, u' and E of the best of 1, 2, ... channels. A deep
image of low resolution then does not hide what a sharp one shows of a galaxy.
Light of stars in M counts by STAR_MODEL_ERROR. Of two galaxies that are alike each has its own
light in the data, and neither shape is doubted: alike is |u|^2 / |u_j|^2, at most 1, in the mean
of the others u_j by their light in u.
The prior on its shape is made stronger by that factor instead, which has the same effect and leaves
its neighbours' shapes unchanged. A faint galaxy beside a bright one then has the expected shape;
the bright one's own data outweigh the prior. Stars have no shape, and their positions are fixed by
their cores.
"""

from __future__ import annotations

import numpy as np

from ..profiles import ELLIPTICITY_SCATTER, GalaxyProfile, StarProfile

# Indices of the parameters of `profiles.GalaxyProfile` whose prior is updated, ln sigma and ln
# beta. Then their scatter between scenes and within a scene, which together equal that of a single
# galaxy (SIZE_SCATTER, WINGS_SCATTER), and the weight of the prior scatter within a scene, in
# galaxies. Mean SDRs of simulated COSMOS galaxies are 0.1 dB (joint) to 0.2 dB (Rubin's or Euclid's
# images alone) above those with the fixed prior (180 scenes, seeds from 3000, 4000 and 5000).
# GALAXY_SCATTER from 0.15 to 0.27 and 0.35 to 0.5, or a WEIGHT of 8, change them by up to 0.03 dB;
# updating the scatter of ellipticities too costs up to 0.1 dB.
LEARNED = np.array([0, 3])
SCENE_SCATTER, GALAXY_SCATTER, WEIGHT = np.array([0.35, 1.06]), np.array([0.2, 1.06]), 4.0
# Smallest number of galaxies in a scene for which the prior is updated.
MIN_GALAXIES = 2
# [1] Smallest information of a scene's best known galaxy relative to which others count.
MIN_INFORMATION = 0.01
# Degrees of freedom. With 4, one galaxy three times as large as five others does not change the
# prior of these; with a Gaussian their scatter would grow from 0.2 to 0.35. Fits of simulated
# galaxies are equal with both. A single galaxy's size and wings have the same tails before updates:
# data can override the prior.
STUDENT_DOF = 4.0
# Part of galaxies of any ellipticity: those expected round would pay 200 in chi2 for an axis ratio
# of 0.2, 15 with this. Of 60 rows and crosses about a flat galaxy of signal to noise 20 to 200
# (Euclid and Rubin, and Rubin alone) 14 are silently wrong without it, 4 with it. Student's tails
# of 4 degrees of freedom in g cost 0.1 dB, this 0.02 dB (88 scenes, seeds 84001 and 85001).
ANY_SHAPE = 0.3
# Relative error of a neighbour's model, of one sign over a whole galaxy. With 0.1 the mean SDR of
# simulated COSMOS galaxies is 0.1 dB above that without it; with 0.2 the gain is 0.13 dB (joint,
# and Euclid alone) to 0.28 dB (Rubin alone), and with 0.5 the same (180 scenes, seeds from 3000,
# 4000 and 5000). With 0.5 the shapes of two overlapping bright galaxies, a merger in HSC's images,
# stay wrong.
NEIGHBOUR_MODEL_ERROR = 0.2
# The same of a star: its model is the PSF, uncertain by the default Settings.psf_error, which other
# values of that leave as it is. With 0.2 a galaxy of sigma 3 px and signal to noise 20 has 0.61 to
# 0.69 of its flux at 16 to 40 px from a saturated star, five of its errors, and 0.80 to 0.97 within
# 1.1 errors with 0.03 (tests/measurement/test_saturated_stars.py).
STAR_MODEL_ERROR = 0.03
# Light of alike neighbours, as a part of a galaxy's own at its place, that leaves no doubt of its
# shape. With 0.5 one of 12 pairs of equals has half of its light in the other one, with 0 one in
# five (bench.ladder, pair, seeds 101 and 303). With 0 14 of 24 galaxies of n = 3 and signal to
# noise 90 amid three of 30 (Rubin's images) have 5 errors too little flux, 0.82 of it in the mean;
# with 1.5 none, and 0.95. Mean SDRs of simulated COSMOS galaxies are 0.02 dB lower (88 scenes,
# seeds 84001 and 85001).
OWN_LIGHT = 1.5


class PopulationPrior:
    """Prior on the profiles of the components of B scenes.

    shapes (N): their ComponentProfiles; scene, index (N,): of each, below B and n; n_parameters: p

    mean, scatter (B, n, p): of their parameters, 0 and 1 where there are none
    contamination (B, n): 1 + E^2, see the module's text
    galaxies, stars (B, n): bool, of which there are galaxies and stars
    """

    def __init__(self, shapes, scene, index, n_scenes, n_most, n_parameters):
        size = n_scenes, n_most, n_parameters
        self.mean, self.scatter = np.zeros(size), np.ones(size)
        self.contamination = np.ones(size[:2])
        self.galaxies, self.stars, self._known = np.zeros((3, *size[:2]), bool)
        for b, i, shape in zip(scene, index, shapes, strict=True):
            n = len(shape.mean)
            self.mean[b, i, :n], self.scatter[b, i, :n] = shape.mean, shape.scatter
            self.galaxies[b, i] = isinstance(shape, GalaxyProfile)
            self.stars[b, i] = isinstance(shape, StarProfile)
            # components of one source differ by more than galaxies
            self._known[b, i] = self.galaxies[b, i] and shape.whole
        self._before = self.mean[..., LEARNED]
        self._common, self._own = (
            np.zeros((n_scenes, len(GALAXY_SCATTER))),
            np.tile(GALAXY_SCATTER, (n_scenes, 1)),
        )
        self._several = self._known.sum(1) >= MIN_GALAXIES

    def reset(self, scenes, other):
        """Takes over the prior of some scenes of another one, for the same components."""
        for name in ("mean", "scatter", "contamination", "_common", "_own"):
            getattr(self, name)[scenes] = getattr(other, name)[scenes]

    def set_contamination(self, scenes, found):
        """Stores the contamination of shapes of some scenes, (k, n) of `contamination_factors`."""
        self.contamination[scenes] = np.where(self.galaxies[scenes], found, 1)

    def precision(self, scenes, theta):
        """Precisions (k, n, p) of the prior on the parameters (B, n, p) of some scenes."""
        weight = _pulls(self._away(scenes, theta))[1]
        weight = np.where(self.galaxies[scenes][..., None], weight, 1)
        return self.contamination[scenes][..., None] * weight / np.square(self.scatter[scenes])

    def penalty(self, scenes, theta):
        """Term added to chi2 (k,) of some scenes; theta (B, n, p)."""
        away = self._away(scenes, theta)
        pulled = np.where(self.galaxies[scenes][..., None], _pulls(away)[0], away)
        return (self.contamination[scenes][..., None] * pulled).sum(axis=(1, 2))

    def penalty_of(self, scene, index, theta):
        """Terms (k,) added to chi2 by parameters (k, p) of one galaxy."""
        away = np.square((theta - self.mean[scene, index]) / self.scatter[scene, index])
        return self.contamination[scene, index] * _pulls(away)[0].sum(axis=1)

    def _away(self, scenes, theta):
        """Squared distances (k, n, p) of parameters (B, n, p) from their means, in scatters."""
        return np.square((theta[scenes] - self.mean[scenes]) / self.scatter[scenes])

    def update(self, scenes, theta, normal):
        """Updates the prior of some scenes from their galaxies.

        theta (B, n, p); normal (k, n, p, p): of each one's equations, with the prior
        """
        normal, scenes = normal[self._several[scenes]], scenes[self._several[scenes]]
        variance = np.diagonal(np.linalg.inv(normal), axis1=2, axis2=3)
        # equivalent to dividing the data's precision, instead of multiplying the prior's
        variance = variance * self.contamination[scenes][..., None]
        off, known = theta[scenes][..., LEARNED] - self._before[scenes], self._known[scenes]
        self._common[scenes], self._own[scenes], scatter = em_step(
            off, variance[..., LEARNED], known, self._common[scenes], self._own[scenes]
        )
        k, i = np.nonzero(known)
        b = scenes[k]
        at = b[:, None], i[:, None], LEARNED
        self.mean[at] = self._before[b, i] + self._common[b]
        self.scatter[at] = scatter[k, i]


def _pulls(away):
    """Terms (..., 4) of chi2 by squared distances (..., 4) of a galaxy's theta, and their slopes.

    away: from the means, in scatters: those of the ellipticity are 0 and ELLIPTICITY_SCATTER, and
        both its parts have one term, the first one's
    """
    terms, slopes = STUDENT_DOF * np.log1p(away / STUDENT_DOF), 1 / (1 + away / STUDENT_DOF)
    square, variance = away[..., 1] + away[..., 2], ELLIPTICITY_SCATTER**2
    round_ones, far = (1 - ANY_SHAPE) * np.exp(-square / 2), 1 + variance * square
    at_zero = 2 * variance * ANY_SHAPE  # both densities in that of round ones at g = 0
    any_ones = at_zero / far**2
    both = round_ones + any_ones
    terms[..., 1] = -2 * np.log(both / (1 - ANY_SHAPE + at_zero))
    terms[..., 2] = 0
    slopes[..., 1:3] = ((round_ones + 4 * variance * any_ones / far) / both)[..., None]
    return terms, slopes


def contamination_factors(normal, spectra, source, stars):
    """1 + E^2 over the part of the light that counts (k, n), of the components of some scenes.

    See the module's text.

    normal (k, C, n, n): products of their whitened images; spectra (k, C, n)
    source (k, n): to which each belongs; stars (k, n): bool, which of them are stars
    """
    light = np.einsum("kci,kcij,kcj->kcij", spectra, normal, spectra)
    own = np.einsum("kcii->kci", light)
    # products of separate sources may be negative by rounding
    light = np.maximum(light, 0) * (source[:, :, None] != source[:, None])[:, None]
    size, beside = np.sqrt(own.sum(axis=1)), light.sum(axis=1)
    alike = size[:, :, None] / np.maximum(np.maximum(size[:, :, None], size[:, None]), 1e-30)
    alike = (beside * alike**2).sum(axis=2) / np.maximum(beside.sum(axis=2), 1e-30)
    errors = np.where(stars, STAR_MODEL_ERROR, NEIGHBOUR_MODEL_ERROR)
    wrong = np.einsum("kcij,kj->kci", light, errors)
    order = np.argsort(wrong / np.maximum(own, 1e-30), axis=1)  # the least wrong channels first
    own, wrong = (np.take_along_axis(x, order, axis=1).cumsum(axis=1) for x in (own, wrong))
    beyond = np.maximum(wrong - (NEIGHBOUR_MODEL_ERROR * OWN_LIGHT * alike)[:, None] * own, 0)
    known = np.maximum(own, 1e-30)
    factors = np.where(own > 0, own[:, -1:] / known * (1 + beyond**2 / known), np.inf).min(axis=1)
    return np.where(np.isfinite(factors), factors, 1)


def em_step(off, variance, known, common, own):
    """c and s (k, 2) after one step, and the expected scatter of each galaxy (k, n, 2).

    off, variance (k, n, 2): theta - mean, and its variance for each galaxy, with the prior and
        fixed neighbours
    known (k, n): which of them are galaxies; common, own (k, 2): the present c and s
    """
    known, away = known[..., None], (off - common[:, None]) ** 2 + variance
    weight = (STUDENT_DOF + 1) / (STUDENT_DOF + away / own[:, None] ** 2)
    data = known * np.maximum(own[:, None] ** 2 / variance - weight, 0)
    informed, relative = data / (data + weight), data / (data + 1)
    relative /= np.maximum(relative.max(axis=1, keepdims=True), MIN_INFORMATION)
    counted = weight * relative
    # of the data alone: (off - common) / informed + common
    right = (counted * (off - (1 - informed) * common[:, None])).sum(1)
    common = right / ((counted * informed).sum(1) + (own / SCENE_SCATTER) ** 2)
    away = counted * relative * ((off - common[:, None]) ** 2 + variance)
    n_counted = np.square(relative).sum(1)
    own = np.sqrt((WEIGHT * GALAXY_SCATTER**2 + away.sum(1)) / (WEIGHT + n_counted))
    return common, own, own[:, None] / np.sqrt(weight)
