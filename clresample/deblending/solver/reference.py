"""The kernels of the loss (scene.cl, losses.cl) in NumPy, written from their definitions.

The tests compare kernels with it, in float64; the model itself and the gathering of its gradients
are in scene_model.py, which the library uses too.
"""

from __future__ import annotations


def residual(image, data, weights, sky):
    """w r (C, My, Mx) with r = image + sky - data; loss 1/2 sum w r^2; pull (C,) = sum w r."""
    r = image + sky[:, None, None] - data
    return weights * r, 0.5 * (weights * r**2).sum(), (weights * r).sum(axis=(1, 2))


def expected_sky(sky, precision):
    """Loss 1/2 sum p sky^2 of levels (C,) that are expected to be 0, and its slopes p sky (C,)."""
    return 0.5 * (precision * sky**2).sum(), precision * sky
