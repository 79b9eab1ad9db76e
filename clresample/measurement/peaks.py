"""Finds peaks of signal-to-noise images by `sep`: objects above a threshold, deblended.

Source: sep, Barbary 2016 (JOSS 1, 58), after SExtractor, Bertin & Arnouts 1996 (A&AS 117, 393).
"""

from __future__ import annotations

import numpy as np

# sep's deblending: number of levels of equal ratio between threshold and peak, and the smallest
# fraction of an object's light in a branch that becomes an object. With SExtractor's 32 levels and
# 0.005, neighbours of bright galaxies are lost, because their branches span few levels. With less
# than 0.001, clumps of large galaxies become objects.
N_LEVELS, MIN_CONTRAST = 256, 0.001
# How often sep's limits are doubled: to 32 times an image's pixels in its buffer, and to 32,768
# branches of one object, some 100 bytes for each of both
DOUBLINGS = 5


def import_sep():
    try:
        import sep
    except ImportError as error:
        raise ImportError("detection needs sep, which is not installed: pip install sep") from error
    return sep


def new_peaks(sep, image, threshold, area, known, apart, own=True):
    """Positions (y, x) and heights of the objects in a signal-to-noise image, brightest first.

    area [px]: smallest area of an object
    known: positions (2,) of sources; objects whose peak is within `apart` [px] of one are left out
    own: also leave out objects that contain a known source: under a wide filter a pair of sources
        is one object with its peak between them
    """
    objects, segments = _objects(sep, image, threshold, area)
    places = np.array(known).reshape(-1, 2)
    at = np.clip(np.rint(places).astype(int), 0, np.array(image.shape) - 1)
    taken = set(segments[at[:, 0], at[:, 1]].tolist()) if own else set()
    found = []
    for i, (position, peak) in enumerate(objects, start=1):
        near = len(places) and np.hypot(*(places - position).T).min() <= apart
        if i not in taken and not near:
            found.append((position, peak))
    return sorted(found, key=lambda one: -one[1])


def _objects(sep, image, threshold, area):
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
    return [
        (np.array([o["ypeak"], o["xpeak"]], float), float(o["peak"])) for o in objects
    ], segments


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
