"""Finds observations, and channels of one, whose light lies at different sky positions."""

from __future__ import annotations

import numpy as np

from ..settings import AUTO
from .centroids import common, over_channels
from .disagreement import ImagePlane, shifts_at

# [model px] Smallest shift that counts: world coordinates of good surveys agree to about this, and
# smaller shifts change fluxes by less than the PSF's errors.
MIN_SHIFT_PX = 0.25
# Largest error of a shift that counts, in pixels of the observation, and at least MIN_SHIFT_PX:
# larger ones are of one doubtful source. With MIN_SHIFT_PX alone no shift of an image with pixels
# of 0.6" beside one of 0.05" counted below a signal to noise of some 300.
MAX_SHIFT_ERROR_PX = 0.1
# [px] Smallest shift that counts between channels of one observation.
MIN_CHANNEL_PX = 0.15
# [sigma] Significance of a shift between observations, and between channels; the latter are many
# more, and colour differences inside a galaxy look like shifts.
SHIFT_SIGMAS, CHANNEL_SIGMAS = 3.0, 5.0
# Fraction of the smallest shift from which the centroids are verified by the images themselves,
# which takes ten times as long; neighbours bias centroids.
CLOSER = 0.7
# Channels of each observation that are compared, those of most light; the second one only if the
# first one's shift has MAYBE_SIGMAS: it has 2.5 at least in all 27 of 50 COSMOS scenes that show
# shifts of 0.3, 0.4 and 0.6 px in two channels (seeds from 200).
MAX_CHANNELS, MAYBE_SIGMAS = 2, 2.0
# [px of the coarser image] Shifts of single sources with larger errors are ignored.
MAX_ERROR_PX = 0.5


def disagreements(images, found, fit_shifts):
    """Shifts (n_observations, 2) [model px] that align disagreeing observations; 0 for the first.

    None without disagreement. Also returns a sentence on each, and on channels that disagree. Right
    are the most that agree, of equally many those with the sharpest image.

    images, found: InspectedImage and Centroids of each observation; fit_shifts: see Settings, with
        True nothing is measured
    """
    if fit_shifts != AUTO and fit_shifts:
        return None, []
    lines, first = [], sharpest(images)
    shifts, errors = np.zeros((2, len(images), 2))
    for i, image in enumerate(images):
        lines += _channel_lines(image, found[i])
        if i == first:
            continue
        shift, error = _between(images[first], found[first], image, found[i])
        if significant(shift, error, most=_largest_error(image)):
            shifts[i], errors[i] = shift, error
        elif not error.max() < MIN_SHIFT_PX:
            shifts[i] = np.nan  # not measured
    apart, largest = np.hypot(*(shifts[:, None] - shifts).transpose(2, 0, 1)), errors.max(axis=1)
    least = np.maximum(MIN_SHIFT_PX, np.hypot(largest[:, None], largest))
    agreeing = (apart < least).sum(axis=1) + 0.5 * (np.arange(len(images)) == first)
    right = int(agreeing.argmax())
    away = apart[right, :, None] >= least[right, :, None]
    moved = np.where(away, shifts[right] - shifts, 0.0)
    errors = np.hypot(errors, errors[right])
    name = images[right].observation.label
    cure = "the fit moves them" if fit_shifts else "give fit_shifts=True"
    for i in np.flatnonzero(moved.any(axis=1)):
        alone = len(np.intersect1d(found[right].sources, found[i].sources)) < 2
        or_else = ", or the only source that shows it varies or has a neighbour" if alone else ""
        lines.append(
            f"light in {images[i].observation.label} lies away from that in {name}: by "
            f"({-moved[i, 0]:+.2f}, {-moved[i, 1]:+.2f}) +- {errors[i].max():.1g} model pixels "
            f"(y, x); their WCS disagree{or_else}; {cure}"
        )
    return (moved - moved[0] if fit_shifts and moved.any() else None), lines


def significant(shift, error, least=MIN_SHIFT_PX, sigmas=SHIFT_SIGMAS, most=0.0):
    """Returns True if a shift (2,) with errors (2,) exceeds `least`, and `sigmas` of its errors.

    Errors larger than `least` and `most` come from one doubtful source: such a shift is not
    significant.
    """
    known = error.max() < max(least, most)
    return known and np.hypot(*shift) > least and np.hypot(*(shift / error)) > sigmas


def _largest_error(image):
    """Largest error [model px] of a shift of an image that counts."""
    return MAX_SHIFT_ERROR_PX / np.sqrt(abs(np.linalg.det(image.matrix)))


def sharpest(images) -> int:
    """Selects the image with the narrowest PSF on the sky."""
    return int(np.argmin([image.width_arcsec for image in images]))


def _between(one, its, other, theirs):
    """Shift (2,) [model px] of the light in image `other` against `one`, and its error (2,).

    Measured from their Centroids; if these differ, from the images themselves.
    """
    _, at, there = np.intersect1d(its.sources, theirs.sources, return_indices=True)
    ends = []
    for image, found, chosen in ((one, its, at), (other, theirs, there)):
        offsets, errors = (values[chosen] for values in over_channels(found))
        inverse = np.linalg.inv(image.matrix)
        ends.append((offsets @ inverse.T, errors * np.sqrt(abs(np.linalg.det(inverse)))))
    (first, first_error), (second, second_error) = ends
    shift, error = common(second - first, np.hypot(first_error, second_error))
    # light may lie too far from its places for a centroid under the sharper PSF
    lost = np.isinf(error).all() and np.isfinite([first_error, second_error]).any()
    closer = lost or _suspect(shift, error, MIN_SHIFT_PX)
    return _closer(one, other) if closer else (shift, error)


def _closer(one, other):
    """The shift and its error by `shifts_at`, between the channels of most light."""
    chosen = other.brightest
    places = other.model_places(chosen[one.inside[chosen]])
    inverse = np.linalg.inv(other.matrix)
    scale = np.sqrt(abs(np.linalg.det(inverse)))
    plane = ImagePlane.of(one, channels_of_light(one)[0])
    shifts, errors = np.zeros((0, 2)), np.zeros(0)
    for n, c in enumerate(channels_of_light(other)[:MAX_CHANNELS], 1):
        found = _trusted(*shifts_at(plane, ImagePlane.of(other, c), places))
        shifts, errors = np.concatenate([shifts, found[0]]), np.concatenate([errors, found[1]])
        shift, error = common(shifts @ inverse.T, errors * scale)
        error = error * np.sqrt(n)  # errors of a source are common to all channels
        if not significant(shift, error, sigmas=MAYBE_SIGMAS, most=_largest_error(other)):
            break
    return shift, error


def _suspect(shift, error, least):
    """Returns True if centroids' shift (2,) with errors (2,) may be one of more than `least`."""
    return np.isfinite(error).all() and np.hypot(*shift) > CLOSER * least


def _trusted(shifts, errors):
    """Shifts and errors, the errors infinite if a shift is too uncertain."""
    return shifts, np.where(errors < MAX_ERROR_PX, errors, np.inf)


def channels_of_light(image):
    """Channels (C,) of an InspectedImage, those in which its sources are brightest first."""
    light = np.maximum(image.significance, 0) ** 2
    return np.argsort(-light.sum(axis=(1, 2)), kind="stable")


def _channel_lines(image, found):
    """Messages about channels whose light is displaced from that of the brightest one."""
    n_channels = found.offsets.shape[1]
    if n_channels == 1 or not len(found.sources):
        return []
    first = channels_of_light(image)[0]
    lines = []
    for c in range(n_channels):
        if c == first:
            continue
        apart = found.offsets[:, c] - found.offsets[:, first]
        shift, error = common(apart, np.hypot(found.errors[:, c], found.errors[:, first]))
        # channels of one observation have nearly one PSF, and neighbours move all centroids alike
        if not _suspect(shift, error, MIN_CHANNEL_PX) or np.hypot(*(shift / error)) < SHIFT_SIGMAS:
            continue
        planes = ImagePlane.of(image, first), ImagePlane.of(image, c)
        shift, error = common(*_trusted(*shifts_at(*planes, image.model_places(image.brightest))))
        if significant(shift, error, MIN_CHANNEL_PX, CHANNEL_SIGMAS):
            names = image.observation.channels
            lines.append(
                f"{image.observation.label}: light in channel {names[c]} lies away from that in "
                f"{names[first]}: by ({shift[0]:+.2f}, {shift[1]:+.2f}) +- {error.max():.1g} px "
                "(y, x); give the channels as observations of their own, which fit_shifts moves"
            )
    return lines
