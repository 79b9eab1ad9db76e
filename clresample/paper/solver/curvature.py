"""Curvature of the loss in each morphology, for the steps of a solver.

The Hessian of the loss by z (by S without a prior) is H = K amplitude A R^T w R A amplitude K, plus
1 with a prior. Its entries are hardly ever negative, so its largest eigenvalue is at most its
largest row sum, which is the largest pixel of H applied to an image of ones.

In simulated Euclid + Rubin scenes this bound is twice the largest eigenvalue (median; 1.4 to 11
times). It is 60 times H along a single pixel (1.6 to 150 times), because of the blur between
pixels. The scatter of a gradient of pure noise is the root of the single-pixel value, not of the
bound.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d

from ...deblending.solver.scene_model import compose, gather_morph

# [sqrt(bound)] A larger gradient at the start means a bad start. The largest pixel of a gradient of
# pure noise has 0.13 of the bound's root (median of the same scenes; 0.2 at most, and 0.66 without
# a prior). With a smaller value noise would count as a bad start, and steps would be damped too
# little; with a larger one steps from a bad start would be damped.
NOISE_GRADIENT = 0.7


def damping(scene, state, prior) -> np.ndarray:
    """Gradient (S,) by which each source's steps are damped: a bound on its curvature.

    If the start is far from the data, g > NOISE_GRADIENT sqrt(curvature), it falls as g^-2, because
    the size of the gradient itself then limits the steps.

    scene, state: a Scene and its State at the start; prior: the SingleScalePrior, or None for plain
        morphologies
    """
    ones = [np.ones_like(profile) for profile in scene.profile]
    pairs = zip(ones, scene.profile, strict=True)
    units = [_spread(one, profile, prior) for one, profile in pairs]
    steep = _pull(scene, state, units, prior, rest=False)
    curvature = np.array([d.max() for d in steep]) + (prior is not None)
    slopes = _pull(scene, state, state.morph, prior, rest=True)
    slope = np.array([np.abs(d).max() for d in slopes])
    curvature = np.maximum(curvature, np.finfo(float).tiny)
    return curvature / np.maximum(1, slope**2 / curvature / NOISE_GRADIENT**2)


def _pull(scene, state, morphs, prior, *, rest):
    """Products of R^T w R with the model of `morphs`, or its `rest`: S arrays (ny, nx)."""
    by_morph, parts = 0, zip(scene.channels(), scene.ops, scene.weights, scene.data, strict=True)
    for i, (part, op, weights, data) in enumerate(parts):
        spectra = scene.parts(i, state.spectra[:, part])
        image = op.forward(compose(scene.shape, scene.origin, morphs, spectra))
        if rest:
            image = image + state.sky[part, None, None] - data
        pull = op.adjoint(weights * image).astype(np.float64)
        own = gather_morph(pull, scene.origin, scene.profile, spectra)
        by_morph = own if i == 0 else [a + b for a, b in zip(by_morph, own, strict=True)]
    pairs = zip(by_morph, scene.profile, strict=True)
    return [_gather(image, profile, prior) for image, profile in pairs]


def _spread(image, profile, prior):
    """amplitude o K image, or the image itself without a prior."""
    if prior is None:
        return image
    return prior.amplitude(profile) * _correlate(image, prior.taps)


def _gather(image, profile, prior):
    """The transpose of `_spread`."""
    if prior is None:
        return image
    return _correlate(prior.amplitude(profile) * image, prior.taps)


def _correlate(image, taps):
    """K image: the taps along both axes, zero beyond the image's edges."""
    return convolve1d(convolve1d(image, taps, 0, mode="constant"), taps, 1, mode="constant")
