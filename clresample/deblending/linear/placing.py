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


def place_windows(offset, matrix):
    """Whole pixels (n, 2) by which windows move, and the rest of their offsets (n, 2) [model px].

    offset (n, 2) [model px]: of an observation from a plan's window, which lies about a box, for
        each box; matrix (n, 2, 2): of the mappings
    """
    low = np.rint(-np.einsum("nij,nj->ni", np.linalg.inv(matrix), offset))
    return low.astype(int), offset + np.einsum("nij,nj->ni", matrix, low)
