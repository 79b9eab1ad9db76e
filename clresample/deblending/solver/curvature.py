"""How steep the loss is in each morphology, so that a solver's steps can respect it.

The Hessian of the loss by z (or by S, without a prior) is K amp A R^T w R A amp K (+ 1). Its
entries
are hardly ever negative, so its largest eigenvalue is at most its largest row sum: what it makes of
an image of ones.  Noise alone gives gradients of its root.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d

# Gradients, in roots of the bound, that say that more than noise is left to fit: the bound is some
# hundred times too large, as many as pixels that are blurred into each other, so noise gives a
# third.
NOISE_GRADIENT = 0.7


def damping(problem, prior) -> np.ndarray:
    """Gradient (S,) by which each source's steps are damped: a bound on its curvature.

    Where the start is far from the data, g > NOISE_GRADIENT sqrt(curvature), it falls as g^-2:
    there the size of the gradient itself limits the steps.

    problem: problem.Problem at its start; prior: its Prior, or None for plain morphologies
    """
    ones = [np.ones_like(base) for base in problem.base]
    units = [_spread(one, base, prior) for one, base in zip(ones, problem.base, strict=True)]
    steep = _pull(problem, _model(problem, units), prior, rest=False)
    curvature = np.array([d.max() for d in steep]) + (prior is not None)
    slopes = _pull(problem, _model(problem, problem.morph), prior, rest=True)
    slope = np.array([np.abs(d).max() for d in slopes])
    curvature = np.maximum(curvature, np.finfo(float).tiny)
    return curvature / np.maximum(1, slope**2 / curvature / NOISE_GRADIENT**2)


def _boxes(problem):
    return [
        (slice(None), *(slice(o, o + n) for o, n in zip(origin, base.shape, strict=True)))
        for origin, base in zip(problem.origin, problem.base, strict=True)
    ]


def _model(problem, images):
    """The scene (C, Ny, Nx) with these images in the sources' boxes."""
    model = np.zeros((problem.spectra.shape[1], *problem.shape))
    for spectrum, box, image in zip(problem.spectra, _boxes(problem), images, strict=True):
        model[box] += spectrum[:, None, None] * image
    return model


def _pull(problem, model, prior, *, rest):
    """What R^T w R makes of a model, or of its residual `rest`, by each source's variable."""
    pulls, channel = [], 0
    for op, weights, data in zip(problem.ops, problem.weights, problem.data, strict=True):
        part = slice(channel, channel + op.shape_out[0])
        channel = part.stop
        image = op.forward(model[part])
        if rest:
            image = image + problem.sky[part, None, None] - data
        pulls.append(op.adjoint(weights * image))
    pull = np.concatenate(pulls).astype(np.float64)
    return [
        _gather(np.tensordot(spectrum, pull[box], 1), base, prior)
        for spectrum, box, base in zip(problem.spectra, _boxes(problem), problem.base, strict=True)
    ]


def _spread(image, base, prior):
    """amp o K image, or the image itself without a prior."""
    if prior is None:
        return image
    return prior.amplitude(base) * _correlate(image, prior.taps)


def _gather(image, base, prior):
    """The transpose of `_spread`."""
    if prior is None:
        return image
    return _correlate(prior.amplitude(base) * image, prior.taps)


def _correlate(image, taps):
    return convolve1d(convolve1d(image, taps, 0, mode="constant"), taps, 1, mode="constant")
