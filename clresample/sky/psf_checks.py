"""What can be wrong with a PSF image that can be used all the same, and its warning."""

from __future__ import annotations

import math

import numpy as np

# [samples] half of what confusing the centre n/2 with (n-1)/2 gives, well above centroid errors
CORE_TOLERANCE = 0.25
# light beyond the image's edge worth telling; by this rule, good HST and HSC images have 2 to 5 %
EDGE_TOLERANCE = 0.05


class PSFWarning(UserWarning):
    """A PSF image that can be used, but hardly means what it says."""


def core_of(image):
    """Fixed point c of sum_s w(s - c) P[s] (s - c) = 0, w a Gaussian as wide as the core."""
    peak = np.unravel_index(np.argmax(image), image.shape)
    # sigma of a round core with as many samples above half its maximum; one sample at least
    n_half = np.count_nonzero(image > 0.5 * image[peak])
    sigma = max(math.sqrt(n_half / math.pi / (2 * math.log(2))), 1.0)
    core = np.array(peak, dtype=np.float64)
    for _ in range(50):  # a Gaussian core halves its error at least once per step
        y, x = (np.arange(n) - c for n, c in zip(image.shape, core, strict=True))
        weight_y, weight_x = np.exp(-0.5 * (y / sigma) ** 2), np.exp(-0.5 * (x / sigma) ** 2)
        weighted = weight_y[:, None] * image * weight_x
        # twice the weighted centroid is the full step when core and weight are equally wide
        step = 2 * np.array([weighted.sum(axis=1) @ y, weighted.sum(axis=0) @ x]) / weighted.sum()
        if not (np.abs(core + step - peak) <= 2 * sigma).all():
            return np.array(peak, dtype=np.float64)  # noise, not a core: the brightest sample
        core += step
        if np.abs(step).max() < 1e-6:  # samples; far below anything that is told
            break
    return core
