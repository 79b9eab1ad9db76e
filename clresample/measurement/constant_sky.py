"""Constant levels of the sky that are left in images, found with the sources of a first search."""

from __future__ import annotations

import numpy as np

from ..deblending.inspection.image import InspectedImage
from ..deblending.inspection.inspect import wrong_levels
from ..deblending.inspection.levels import sky_level
from ..sky.noise import background
from ..sky.observation import with_data

# [sigma of a pixel] Median levels, sources clipped away, over which a first search is made without
# them: at 0.5 sigma it would find as many peaks of the sky as sources.
MIN_MEDIAN = 0.2


def search_without_sky(observations, frame, search):
    """The result of search(observations) without the constant levels of the sky in them.

    A median is not the level of the sky where sources fill an image. So the levels are those that
    a fit of the sources found would use: of dark pixels away from all of them (`sky_level`), where
    these are certainly not 0.

    search: of observations; returns a Detection on the frame
    """
    medians = [_medians(o) for o in observations]
    lowered = any(level.any() for level in medians)
    found = search(_lowered(observations, medians))
    places = np.array([source.position_px for source in found.sources]).reshape(-1, 2)
    levels = [_level(o, frame, places) for o in observations]
    if lowered or any(level.any() for level in levels):
        return search(_lowered(observations, levels))
    return found


def _lowered(observations, levels):
    """The observations minus levels (C,) [counts] of each."""
    pairs = zip(observations, levels, strict=True)
    return [with_data(o, o.data - x[:, None, None]) if x.any() else o for o, x in pairs]


def _medians(observation):
    """Median level (C,) [counts] of the background of each channel, 0 if it is small."""
    found = np.zeros(len(observation.data))
    for c, (image, weights) in enumerate(zip(observation.data, observation.weights, strict=True)):
        if (usable := weights > 0).any():
            level, sigma = background(image, ~usable)
            found[c] = level if abs(level) > MIN_MEDIAN * sigma else 0.0
    return found


def _level(observation, frame, places):
    """Level (C,) [counts] of the sky beside sources at places (S, 2) [model px], 0 if it may be."""
    image = InspectedImage.of(observation, frame, places, np.zeros(2))
    sky = sky_level(image)
    wrong, dark = wrong_levels(image.over(sky.level), sky)
    return np.where(wrong, sky.level, np.where(dark, np.minimum(sky.rim, sky.level), 0.0))
