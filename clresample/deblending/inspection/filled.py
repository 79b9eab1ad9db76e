"""Masks pixels without data that are filled with a number, such as zeros beyond an edge."""

from __future__ import annotations

import numpy as np

from ...sky.filled import filled_pixels, is_noise
from ...sky.observation import masked
from .spoilt import FLAT_SIGMAS, saturated_pixels

MAX_NAMED = 3  # values in a message


def without_filled(observations) -> tuple[tuple, list[list[str]]]:
    """The observations with their pixels without data masked, and lines about these of each.

    They are those of `sky.filled`, without the flat tops of saturated stars, and all pixels of
    channels of a single value, if other channels have noise. Observations without any are returned
    as they are.
    """
    observations, constant, noisy = tuple(observations), {}, False
    filled = [np.zeros(o.data.shape, bool) for o in observations]
    for i, o in enumerate(observations):
        for c, (image, weights) in enumerate(zip(o.data, o.weights, strict=True)):
            usable = weights > 0
            values = image[usable]
            if values.size and (values == values[0]).all():
                constant[i, c] = usable
            else:
                filled[i][c] = filled_pixels(image, usable, weights)
    if constant:
        noisy = any(
            (i, c) not in constant and is_noise(image, (w > 0) & ~filled[i][c], w)
            for i, o in enumerate(observations)
            for c, (image, w) in enumerate(zip(o.data, o.weights, strict=True))
        )
    if noisy:
        for (i, c), usable in constant.items():
            filled[i][c] = usable
    for o, found in zip(observations, filled, strict=True):
        if found.any():
            found &= ~_flat_tops(o, found)
    pairs = list(zip(observations, filled, strict=True))
    return (
        tuple(masked(o, found) if found.any() else o for o, found in pairs),
        [_lines(o, found) for o, found in pairs],
    )


def _flat_tops(observation, chosen):
    """Pixels (C, My, Mx) bool with the values of saturated stars' flat tops among those chosen."""
    o, usable = observation, observation.weights > 0
    light = np.where(usable, o.data * np.sqrt(o.weights), 0)
    tops = chosen & (light > FLAT_SIGMAS) & saturated_pixels(o, light, usable)
    pairs = zip(o.data, tops, strict=True)
    return np.array([np.isin(image, image[top]) for image, top in pairs])


def _lines(observation, filled):
    """Messages about filled pixels (C, My, Mx)."""
    lines = []
    for c in np.flatnonzero(filled.any(axis=(1, 2))):
        y, x = np.argwhere(filled[c])[0]
        values = np.unique(observation.data[c][filled[c]])
        some = ", ".join(f"{value:.6g}" for value in values[:MAX_NAMED])
        lines.append(
            f"channel {observation.channels[c]} has pixels of exactly one value, which noise does "
            f"not have, taken for pixels without data and masked: {filled[c].sum()} of {some}"
            f"{' and other values' if len(values) > MAX_NAMED else ''}, the first at (y, x) = "
            f"({y}, {x})"
        )
    return lines
