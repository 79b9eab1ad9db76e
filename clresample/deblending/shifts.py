"""Constant shifts between observations, from the model as it stands.

A model fitted to images with a relative shift lies between them. Each image's own best shift
against the model, to first order, is t_o. The differences of these are the shifts between the
images, for sources of any shape:

    t_o = (D_o^T w_o D_o)^-1 D_o^T w_o (d_o - R_o M),    D_o = R_o dM/dx,    step = t_o - t_first
"""

from __future__ import annotations

import numpy as np

from .linear.normal import SCATTER_PX
from .solver.scene_model import compose

# Largest assumed ratio of successive steps.
MAX_DECAY_FACTOR = 0.8


def shift_steps(scene, state) -> tuple[np.ndarray, float]:
    """Steps of the observations (n_observations, 2) [model px], 0 for the first, and their gain.

    The gain is the decrease of half of chi2, to second order, if the model fits the first
    observation.

    scene: a Scene, its operators at their present shifts; state: its present State
    """
    n_y, n_x = scene.unpadded_shape
    found = []
    parts = zip(scene.channels(), scene.ops, scene.data, scene.weights, strict=True)
    for i, (part, op, data, weights) in enumerate(parts):
        spectra = scene.parts(i, state.spectra[:, part])
        light = compose(scene.shape, scene.origin, state.morph, spectra)[:, :n_y, :n_x]
        images = np.zeros((3, *op.shape_in))
        images[..., :n_y, :n_x] = (light, *np.gradient(light, axis=(1, 2)))
        seen, *slopes = op.forward(images.astype(op.dtype)).astype(np.float64)
        rest = weights * (data - seen - state.sky[part, None, None])
        normal = np.einsum("icyx,jcyx,cyx->ij", slopes, slopes, weights)
        normal += np.eye(2) / SCATTER_PX**2
        found.append((normal, np.linalg.solve(normal, np.einsum("icyx,cyx->i", slopes, rest))))
    steps = np.array([own for _, own in found]) - found[0][1]
    gain = sum(0.5 * step @ normal @ step for (normal, _), step in zip(found, steps, strict=True))
    return steps, float(gain)


def extrapolate(steps, last):
    """Limits (n, 2) of the sums of geometrically decreasing steps, from the `last` ones.

    The model follows each shift only in part, so that the steps sum up to the first one divided by
    1 minus the ratio of successive steps.
    """
    factor = (steps * last).sum() / max((last * last).sum(), 1e-30)
    return steps / (1 - np.clip(factor, 0, MAX_DECAY_FACTOR))
