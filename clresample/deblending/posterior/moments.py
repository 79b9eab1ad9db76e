"""Derivatives of centroids and second moments with respect to morphology pixels."""

from __future__ import annotations

import numpy as np


def moment_derivatives(origins, morphs, light, beyond=None):
    """Slopes of (y, x, yy, yx, xx) of I = sum_i light_i S_i by the pixels of each S_i / light_i.

    origins (k, 2) [px], morphs (k): arrays (ny, nx); light (k,), any unit
    beyond (k, 6): sums over what lies beyond the boxes, see OutsideBoxMoments; None: nothing
    returns k arrays (5, ny, nx), and (5, 6), by the sums over what lies beyond
    """
    at = [
        tuple(axis + o for axis, o in zip(np.indices(m.shape), origin, strict=True))
        for origin, m in zip(origins, morphs, strict=True)
    ]
    beyond = np.zeros((len(morphs), 6)) if beyond is None else beyond
    sums = light @ beyond
    for (y, x), m, part in zip(at, morphs, light, strict=True):
        sums = sums + part * np.array([(v * m).sum() for v in (1, y, x, y * y, y * x, x * x)])
    total, (y, x, yy, yx, xx) = sums[0], sums[1:] / sums[0]
    centre = np.array([yy - y * y, yx - y * x, xx - x * x])
    slopes = []
    for own_y, own_x in at:
        dy, dx = own_y - y, own_x - x
        second = np.array([dy * dy, dy * dx, dx * dx]) - centre[:, None, None]
        slopes.append(np.concatenate([[dy, dx], second]) / total)
    q = y * y - centre[0], y * x - centre[1], x * x - centre[2]
    by_sums = [
        [-y, 1, 0, 0, 0, 0],
        [-x, 0, 1, 0, 0, 0],
        [q[0], -2 * y, 0, 1, 0, 0],
        [q[1], -x, -y, 0, 1, 0],
        [q[2], 0, -2 * x, 0, 0, 1],
    ]
    return slopes, np.array(by_sums) / total
