"""Light of a piece of a cut blend beyond its frame, where the pieces beside it are fitted."""

from __future__ import annotations

import numpy as np

from ...deblending.linear.equations import N_PARAMETERS
from ...deblending.profiles import one_galaxy, profile, psf_second_moment

# [1] Least part of a galaxy's light beyond the frame that is continued.
MIN_BEYOND = 0.001


def galaxies_beyond(result):
    """The galaxies of a Result with light beyond its frame: [(place, GalaxyGaussians, light)].

    place (2,) [px]: in the frame; light (C,) [counts]: of the whole smooth profile, of which the
    morphology has as much as its projection on it
    """
    moment, found = psf_second_moment(result.frame.psf), []
    thetas = (theta for own in result.thetas for theta in own)
    for c, theta in zip(result.components, thetas, strict=True):
        if len(theta) != N_PARAMETERS:
            continue
        place = np.array(result.sources[c.source].position_px)
        some = one_galaxy(theta, moment)
        edge = np.minimum(place, np.array(result.frame.shape) - 1 - place).min()
        if some.outside(max(edge, 0.0)) < MIN_BEYOND:
            continue
        own = profile(theta, place - c.origin, c.morphology.shape, moment, slopes=False)[0]
        part = (own * c.morphology).sum() / max((own**2).sum(), 1e-30)
        found.append((place, some, max(part, 0.0) * c.spectrum))
    return found


def continued(model, galaxies, channels, box, region, mosaic, frame_grid):
    """A model (C, Ny, Nx) [counts] on a Box of a mosaic, continued to a Box `region` around it.

    galaxies: of `galaxies_beyond`; channels: slice of the mosaic's among theirs
    frame_grid: Grid of the frame

    Far from a galaxy the PSF changes its light little: it is that of the profile at the pixels.
    """
    whole = np.zeros((len(model), *region.shape))
    m, n = np.indices(region.shape)
    at = mosaic.grid.cutout(region.y0, region.x0, region.shape).map_to(frame_grid).at(m, n)
    steps = at[1, 0] - at[0, 0], at[0, 1] - at[0, 0]
    area = abs(np.linalg.det(steps))  # [px^2] of the frame
    for place, some, light in galaxies:
        y, x = np.moveaxis(at - place, -1, 0)
        whole += light[channels, None, None] * (area * some.at(y, x))
    whole[:, *box.relative_to(region).slices] = model
    return whole
