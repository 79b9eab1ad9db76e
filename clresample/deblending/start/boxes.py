"""Boxes of components: the pixels that hold the light of their profiles."""

from __future__ import annotations

import numpy as np

from ...sky.box import box_slices

# A box holds the pixels where the source is brighter than this part of the noise of a model pixel;
# smaller values make larger boxes, which cost time and hold no more light that is seen.
BOX_NOISE = 0.1
# Least and largest threshold, as parts of the profile's peak: a star of any brightness ends where
# its PSF's float32 does; the box of a source that is hardly seen still holds its profile.
BOX_FAINTEST, BOX_BRIGHTEST = 1e-7, 5e-3
# [px] Boxes reach at least this far from their centre, however faint the source.
SMALLEST_RADIUS_PX = 5


def box_threshold(brightness):
    """Part of a profile's peak down to which its pixels belong into its box.

    brightness: the peak over the noise of a model pixel. A pixel belongs there if the profile
    reaches BOX_NOISE of the noise, or if the structure does that the prior allows about it: with
    alpha = 0.1 that is 0.1 sqrt(profile) of the peak, so the profile's part is brightness^-2
    """
    brightness = max(brightness, 1.0)
    return np.clip(min(BOX_NOISE / brightness, brightness**-2), BOX_FAINTEST, BOX_BRIGHTEST)


def box_around(profile, position, brightness):
    """Box of one profile: origin (2,) and shape (2,) inside the frame, and its centre pixel (2,).

    profile (Ny, Nx): over the frame; position (2,) [px]; brightness: its peak over the noise of a
    model pixel, in the channel of highest signal to noise
    """
    threshold = box_threshold(brightness) * profile.max()
    top = np.array(profile.shape) - 1
    pixel = np.clip(np.floor(np.asarray(position) + 0.5).astype(int), 0, top)
    lit = profile > threshold
    low, high = np.zeros(2, int), np.zeros(2, int)
    for axis in (0, 1):
        along = np.flatnonzero(lit.any(axis=1 - axis))
        first, last = (along[0], along[-1]) if len(along) else (pixel[axis], pixel[axis])
        low[axis] = max(min(first, pixel[axis] - SMALLEST_RADIUS_PX), 0)
        high[axis] = min(max(last, pixel[axis] + SMALLEST_RADIUS_PX), top[axis])
    return low, high - low + 1, pixel - low


def component_box(start, i, frame, brightness):
    """`box_around` of a component that a start has found, and its profile there (ny, nx), max = 1.

    start: StartingPoint; i: which component; frame (2,) [px]: the frame's shape
    """
    middle, half = start.reach(i, box_threshold(brightness))
    place, top = start.positions[start.source[i]], np.array(frame)
    low = np.minimum(middle - half, place - SMALLEST_RADIUS_PX) - 1
    high = np.maximum(middle + half, place + SMALLEST_RADIUS_PX) + 2
    low = np.maximum(low, 0).astype(int)
    high = np.minimum(np.ceil(high), top).astype(int)
    image = start.drawn(i, low, high - low)
    inside, size, center = box_around(image, place - low, brightness)
    return low + inside, size, center, image[box_slices(inside, size)]
