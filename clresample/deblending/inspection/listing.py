"""Compares listed sources with the light: doubles, missing ones, wrong positions."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.ndimage import binary_opening, distance_transform_edt

from .centroids import common, over_channels

# [model px] Two sources nearer than this share every pixel, and no image can separate their fluxes.
SAME_PLACE_PX = 1.0
# [sigma] Smallest significance of unlisted light, in all channels together.
UNLISTED_SIGMAS = 10.0
# Unlisted light is reported if it is brighter than this fraction of the typical listed source.
# Fainter light is partly attributed to its neighbours, and changes them little.
UNLISTED_PART = 0.25
# [FWHM of the PSF] Light nearer to a listed source belongs to it; at least in pixels.
OWN_FWHM, OWN_PX = 1.5, 3.0
# [1] of a peak: light that stays above this level up to a listed source belongs to that source, up
# to the edge or a masked part of the image to what lies there. [px] Smallest side of such a part.
SADDLE_PART, MASKED_PX = 0.5, 3
N_NEAREST = 6  # number of the nearest sources that light may belong to
# [px], [sigma] Smallest common offset of all positions that is reported, and its significance.
OFFSET_PX, OFFSET_SIGMAS = 0.6, 4.0
# Smallest number of sources for the error of an offset from their scatter.
MIN_SOURCES = 3
# [px] Typical offset of a galaxy's light within the PSF's width from its catalogued centre.
OFFSET_FLOOR_PX = 0.2


def doubles(sources, positions):
    """Pairs (i, j) of sources of one kind within a pixel of each other.

    positions (S, 2) [model px].
    """
    return [
        (i, j)
        for i, j in combinations(range(len(sources)), 2)
        if type(sources[i]) is type(sources[j])
        and np.hypot(*(positions[i] - positions[j])) < SAME_PLACE_PX
    ]


def common_offset(found):
    """Offset (2,) [px] and its error (2,) of the light from all sources, of their Centroids.

    None if no offset is significant.
    """
    offsets, errors = over_channels(found)
    errors = np.hypot(errors, OFFSET_FLOOR_PX)
    if np.isfinite(errors).sum() < MIN_SOURCES:
        return None
    offset, error = common(offsets, errors)
    far = np.hypot(*offset) > OFFSET_PX and np.hypot(*(offset / error)) > OFFSET_SIGMAS
    return (offset, error) if far else None


def unlisted(image):
    """Peaks [(significance [sigma], y, x [px])] without a source at them, the brightest first."""
    light = image.smooth_brightness
    peaks = _peaks(light, image.smooth > UNLISTED_SIGMAS)
    places = image.places[np.isfinite(image.places).all(axis=1)]
    if not len(peaks) or not image.inside.any():
        return []  # sources that all lie outside are reported by themselves
    values, listed = light[*peaks.T], image.at_sources(light)[image.inside]
    away = np.hypot(*(peaks[:, None] - places).T).T
    apart = away.min(axis=1) >= max(OWN_FWHM * image.width_px, OWN_PX)
    bright = values >= UNLISTED_PART * np.median(np.maximum(listed, 0))
    chosen = np.flatnonzero(apart & bright & image.on_frame(peaks))  # other pixels are not fitted
    if not len(chosen):
        return []
    # masked pixels may be of any brightness
    smooth = np.where(image.usable.all(axis=0), light, np.inf)
    unseen, found = _nearest_unseen(image.usable.any(axis=0)), []
    for i in chosen:
        y, x = peaks[i]
        ends = [unseen[y, x], *places[away[i].argsort()[:N_NEAREST]]]
        if not any(_joined(smooth, (y, x), values[i], place) for place in ends):
            found.append((float(image.smooth[y, x]), int(y), int(x)))
    return sorted(found, reverse=True)


def _nearest_unseen(usable):
    """The nearest pixel (My, Mx, 2) to each that is beyond the edge or in a masked part."""
    unseen = np.pad(~usable, MASKED_PX, constant_values=True)
    unseen = binary_opening(unseen, np.ones((MASKED_PX, MASKED_PX), bool))
    nearest = distance_transform_edt(~unseen, return_distances=False, return_indices=True)
    inner = slice(MASKED_PX, -MASKED_PX)
    return np.moveaxis(nearest, 0, -1)[inner, inner] - MASKED_PX


def _peaks(smooth, chosen):
    """Local maxima (n, 2) on chosen pixels (My, Mx), those on the outermost ones left out."""
    inner, top = smooth[1:-1, 1:-1], chosen[1:-1, 1:-1].copy()
    if not top.any():
        return np.zeros((0, 2), int)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        n_y, n_x = smooth.shape
        top &= inner >= smooth[1 + dy : n_y - 1 + dy, 1 + dx : n_x - 1 + dx]
    return np.argwhere(top) + 1


def _joined(smooth, peak, value, place):
    """Returns True if the light stays high on the line from a peak of this value to a source."""
    n = int(np.ceil(np.hypot(*(np.asarray(place) - peak)))) + 1
    line = np.linspace(peak, place, n)
    y, x = np.clip(np.rint(line).astype(int), 0, np.array(smooth.shape) - 1).T
    return smooth[y, x].min() > SADDLE_PART * value
