"""Constant shifts between observations, from the model as it stands.

A model fitted to images that disagree by a shift is a compromise, which each of them would like to
move; the difference of these wishes is the shift, however irregular the sources are:

    t_o = (D_o^T w_o D_o)^-1 D_o^T w_o (d_o - R_o M),    D_o = R_o dM/dx,    step = t_o - t_first
"""

from __future__ import annotations

import numpy as np

# [model px] an observation that says less of its shift than this is not moved
SCATTER_PX = 2.0


def shift_steps(problem) -> np.ndarray:
    """By how much to move the observations (n_observations, 2) [model px], the first not at all.

    problem: `problem.Problem` in its present state
    """
    model = np.zeros((problem.spectra.shape[1], *problem.shape))
    light = model[:, : problem.extent[0], : problem.extent[1]]
    for spectrum, (y, x), morph in zip(problem.spectra, problem.origin, problem.morph, strict=True):
        n_y, n_x = morph.shape
        model[:, y : y + n_y, x : x + n_x] += spectrum[:, None, None] * morph
    steps, channel = [], 0
    for op, data, weights in zip(problem.ops, problem.data, problem.weights, strict=True):
        part = slice(channel, channel + op.shape_out[0])
        channel = part.stop
        images = np.zeros((3, *op.shape_in))
        images[..., : light.shape[1], : light.shape[2]] = (
            light[part],
            *np.gradient(light[part], axis=(1, 2)),
        )
        seen, *slopes = op.forward(images.astype(op.dtype)).astype(np.float64)
        rest = weights * (data - seen - problem.sky[part, None, None])
        normal = np.einsum("icyx,jcyx,cyx->ij", slopes, slopes, weights)
        normal += np.eye(2) / SCATTER_PX**2
        steps.append(np.linalg.solve(normal, np.einsum("icyx,cyx->i", slopes, rest)))
    return np.array(steps) - steps[0]
