"""Places windows of an observation where the light of boxes reaches."""

from __future__ import annotations

import numpy as np

from ...resampling.plan import ResamplingPlan
from ...resampling.transfer import light_reach


def reach_of(plan: ResamplingPlan, tolerance=0.0):
    """Distance [model px] to which the light of a box is followed.

    tolerance: fraction of the PSF's light beyond it; 0: the padding of the plan's model
    """
    if not tolerance:
        return max(plan.certificate.wrap_radius_px)
    return light_reach(plan.psfs[1], plan.mapping.matrix, tolerance)


def wing_light(plan: ResamplingPlan, reaches):
    """Root (C T, K) [1 / model px] of the PSF's squared light beyond distances, of each band.

    It is the signal to noise of light beyond them, for a flux of 1 and a noise of 1 in a model
    pixel.

    reaches (K,) [model px]: descending
    """
    psf, matrix, found = plan.psfs[1], plan.mapping.matrix, []
    stretch, area = np.linalg.norm(matrix, axis=1).max(), abs(np.linalg.det(matrix))
    for image, center in zip(psf.images, psf.center, strict=True):
        y, x = ((np.arange(n) - c) * psf.spacing for n, c in zip(image.shape, center, strict=True))
        ring = np.searchsorted(reaches[::-1], stretch * np.hypot(y[:, None], x))
        power = np.bincount(ring.ravel(), image.ravel() ** 2, len(reaches) + 1)
        found.append(np.cumsum(power[:0:-1]))
    return np.sqrt(found) / (psf.spacing * np.sqrt(area))


def place_windows(offset, matrix):
    """Whole pixels (n, 2) by which windows move, and the rest of their offsets (n, 2) [model px].

    offset (n, 2) [model px]: of an observation from a plan's window, which lies about a box, for
        each box; matrix (n, 2, 2): of the mappings
    """
    low = np.rint(-np.einsum("nij,nj->ni", np.linalg.inv(matrix), offset))
    return low.astype(int), offset + np.einsum("nij,nj->ni", matrix, low)
