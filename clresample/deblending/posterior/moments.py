"""How centroids and second moments change with the pixels of morphologies."""

from __future__ import annotations

import numpy as np


def moments_of(origins, morphs, light):
    """Slopes (5, ny, nx) of (y, x, yy, yx, xx) by the pixels of I = sum_i light_i S_i, in each box.

    origins (k, 2) [px], morphs (k): arrays (ny, nx); light (k,), any unit
    """
    at = [
        tuple(axis + o for axis, o in zip(np.indices(m.shape), origin, strict=True))
        for origin, m in zip(origins, morphs, strict=True)
    ]
    total = sum(part * m.sum() for part, m in zip(light, morphs, strict=True))

    def mean(values):
        """Of values (k) in the boxes, weighted by I."""
        triples = zip(values, morphs, light, strict=True)
        return sum(part * (v * m).sum() for v, m, part in triples) / total

    c_y, c_x = mean([y for y, _ in at]), mean([x for _, x in at])
    away = [(y - c_y, x - c_x) for y, x in at]
    seconds = [np.array([dy * dy, dy * dx, dx * dx]) for dy, dx in away]
    centre = np.array([mean([s[i] for s in seconds]) for i in range(3)])
    pairs = zip(away, seconds, strict=True)
    return [np.stack([*d, *(s - centre[:, None, None])]) / total for d, s in pairs]
