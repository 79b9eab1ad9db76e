"""Finds peaks of signal-to-noise images by `sep`: objects above a threshold, deblended.

Source: sep, Barbary 2016 (JOSS 1, 58), after SExtractor, Bertin & Arnouts 1996 (A&AS 117, 393).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from .hills import root, saddles, watershed

# sep's deblending: number of levels of equal ratio between threshold and peak, and the smallest
# fraction of an object's light in a branch that becomes an object. With SExtractor's 32 levels and
# 0.005, neighbours of bright galaxies are lost, because their branches span few levels.
N_LEVELS, MIN_CONTRAST = 256, 1e-6
# [1] Smallest light of an object above its saddle, in that of all connected pixels: clumps of large
# galaxies have less. In a crowd so have sources of signal to noise up to 900, so that there the
# brightest object's light counts, if that has at most COMPACT areas of a point source. Objects of
# more areas that rise by the threshold and by STEEP of their saddle are satellites: of 144 clumps
# with less light two have so many areas.
MIN_PART, COMPACT, STEEP = 0.001, 3.0, 0.2
# [sigma] Smallest height of an object above its saddle: the noise has bumps of one.
MIN_RISE = 2.0
# [1] of an object's brightest pixel: its highest local maximum. sep shares out pixels between
# objects, so that this pixel may lie on the flank of another; a sector of a disk has no maximum.
MIN_TOP = 0.7
# [FWHM^2] sum of a point source's image filtered with its PSF, over its peak: 4 pi sigma^2
POINT_AREA = 2.27
# How often sep's limits are doubled: to 32 times an image's pixels in its buffer, and to 32,768
# branches of one object, some 100 bytes for each of both
DOUBLINGS = 5


def import_sep():
    try:
        import sep
    except ImportError as error:
        raise ImportError("detection needs sep, which is not installed: pip install sep") from error
    return sep


def new_peaks(sep, image, threshold, area, fwhm, known, apart, *, own=True, first=False):
    """Positions (y, x) and heights of the objects in a signal-to-noise image, brightest first.

    area [px]: smallest area of an object; fwhm [px]: of the PSF
    known: positions (2,) of sources; objects whose peak is within `apart` [px] of one are left out
    own: also leave out objects that contain a known source: under a wide filter a pair of sources
        is one object with its peak between them
    first: also take wide objects of little light, see STEEP; later images have steps of levels
    """
    objects, segments = _objects(sep, image, threshold, area, fwhm, first)
    places = np.array(known).reshape(-1, 2)
    at = np.clip(np.rint(places).astype(int), 0, np.array(image.shape) - 1)
    taken = set(segments[at[:, 0], at[:, 1]].tolist()) if own else set()
    found = []
    for i, (position, peak) in enumerate(objects, start=1):
        near = len(places) and np.hypot(*(places - position).T).min() <= apart
        if i not in taken and not near:
            found.append((position, peak))
    return sorted(found, key=lambda one: -one[1])


def _objects(sep, image, threshold, area, fwhm, first=False):
    """sep's objects: (position (y, x), height) of each, and their numbers in pixels (Ny, Nx).

    From 1, 0 = none.
    """
    if not image.max(initial=0) > threshold:  # true of most residuals; sep would take 1 ms
        return [], np.zeros(image.shape, np.int32)
    objects, segments = _with_room(
        sep,
        image.size,
        lambda: sep.extract(
            np.ascontiguousarray(image),
            threshold,
            minarea=max(1, int(area)),
            filter_kernel=None,
            deblend_nthresh=N_LEVELS,
            deblend_cont=MIN_CONTRAST,
            segmentation_map=True,
        ),
    )
    peaks = [(np.array([o["ypeak"], o["xpeak"]], float), float(o["peak"])) for o in objects]
    return _without_structure(image, threshold, POINT_AREA * fwhm**2, peaks, segments, first)


def _without_structure(image, threshold, point_area, peaks, segments, first):
    """Objects and their numbers, see `_objects`, without faint ones on the light of brighter ones.

    The pixels of those are in no object.

    point_area [px]: a point source's light over its peak; first: also take wide ones
    """
    if len(peaks) < 2:
        return peaks, segments
    inside, number = image > threshold, np.arange(len(peaks) + 1)
    tops = np.where(ndimage.maximum_filter(image, 3) == image, image, 0)
    lit = np.flatnonzero(segments)
    given = tops.ravel()[lit], segments.ravel()[lit], number[1:]
    top = lit[np.array(ndimage.maximum_position(*given), int)[:, 0]]
    at = np.stack(np.unravel_index(top, image.shape), axis=1)
    height = tops[at[:, 0], at[:, 1]].astype(float)
    base = _saddle_heights(image, inside, at, height)
    above = image - np.concatenate([[0], np.maximum(base, threshold)])[segments]
    light = ndimage.sum_labels(np.maximum(above, 0), segments, number)[1:]
    of, n = ndimage.label(inside, np.ones((3, 3)))
    own = of[at[:, 0], at[:, 1]] - 1
    top = np.array(ndimage.maximum_position(light, own, np.arange(n)), int)[own, 0]
    compact = light[top] < COMPACT * point_area * height[top]
    whole = np.where(compact, light[top], ndimage.sum_labels(image, of, np.arange(n) + 1)[own])
    rise = height - base
    wide = (light > COMPACT * point_area * rise) & (rise > np.maximum(threshold, STEEP * base))
    kept = ((light >= MIN_PART * whole) | (first & wide)) & (rise >= MIN_RISE)
    kept &= height >= MIN_TOP * np.array([peak for _, peak in peaks])
    number[1:] = np.where(kept, np.cumsum(kept), 0)
    found = [(at[i].astype(float), float(height[i])) for i in np.flatnonzero(kept)]
    return found, number.astype(segments.dtype)[segments]


def _saddle_heights(image, inside, at, height):
    """Light (S,) of the highest saddle between each of the peaks at (S, 2) and a higher one."""
    basins = watershed(image, inside, at)
    own = basins[at[:, 0], at[:, 1]] - 1
    found, parent = height.copy(), np.arange(basins.max())
    top, rising = np.zeros(len(parent), int), np.argsort(height)
    top[own[rising]] = rising
    found[top[own]] = 0
    for (a, b), light in zip(*saddles(image, basins, heights=True), strict=True):
        a, b = root(parent, a), root(parent, b)
        if a != b:
            low, high = sorted((a, b), key=lambda k: height[top[k]])
            found[top[low]], parent[low] = light, high
    return found


def _with_room(sep, n_pixels, extract):
    """Runs extract() with sep's limits raised for the objects of an image of n_pixels.

    A bright star's wings may fill an image, as one object of many branches. The limits are
    those of the process, and are only raised.
    """
    sep.set_extract_pixstack(max(n_pixels, sep.get_extract_pixstack()))
    for _ in range(DOUBLINGS):
        try:
            return extract()
        except Exception as error:  # sep raises no more specific class
            if "set_extract_pixstack" in str(error):
                sep.set_extract_pixstack(2 * sep.get_extract_pixstack())
            elif "set_sub_object_limit" in str(error) or "deblend" in str(error):
                sep.set_sub_object_limit(2 * sep.get_sub_object_limit())
            else:
                raise
    return extract()
