"""How a component's smooth profile may change: its parameters, its place, its core and halo."""

from __future__ import annotations

import numpy as np

from ..profiles import Galaxy, Star

# [px] scatter of a catalogue's position. 0.5 makes the errors of faint sources' positions half as
# large again as their scatter.
POSITION_PX = 0.1
# [peak] Scatter of what is added in proportion to p^2, a core, and to sqrt(p), a halo: how galaxies
# differ from the family of profiles. Without them the sizes of simulated bright galaxies lie within
# their errors in 59 %, with them in 70 % of cases.
CORE, HALO = 0.2, 0.05


def profile_modes(shape, theta, position, profile, box):
    """Slopes (k, ny, nx) of a component's profile in its box, and their prior scatter (k,).

    shape: Shape, theta (n,): its parameters, position (2,) [px]: where in the frame
    profile (ny, nx): with max = 1; box: slices of the frame
    """
    if isinstance(shape, Star):
        drawn = shape.draw(np.zeros(len(theta)), position)
        return drawn[1:, *box] / drawn[0].max(), shape.scatter
    if isinstance(shape, Galaxy):
        size, low = profile.shape, [part.start for part in box]
        drawn, position = shape.draw(theta, position - low, size), position - low
        moved = shape.place_slopes(theta, position, drawn[0])
        slopes = np.concatenate([drawn[1:], moved]) / drawn[0].max()
        scatter = shape.scatter
    else:  # a given image
        slopes = np.stack([-_slope(profile, axis) for axis in (0, 1)])
        scatter = np.zeros(0)
    light = np.maximum(profile, 0)
    images = np.concatenate([slopes, [light**2, np.sqrt(light)]])
    return images, np.concatenate([scatter, [POSITION_PX] * 2, [CORE, HALO]])


def _slope(image, axis):
    """Difference quotient along an axis; 0 along a side of one pixel."""
    return np.gradient(image, axis=axis) if image.shape[axis] > 1 else np.zeros_like(image)
