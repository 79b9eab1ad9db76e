"""Light of galaxies beyond what was observed: how much their smooth profiles have there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...sky.footprint import unobserved
from ..profiles import Galaxy


def light_outside(result, shapes, thetas, positions, peaks) -> np.ndarray:
    """Flux outside of what was observed that each source's smooth profile has: (S, C) [counts].

    At most the flux inside. 0 of sources whose boxes end before the border, and of all but
    galaxies: the wings of stars are those of the PSF.

    shapes, thetas, positions (n): of the components' profiles; peaks (n,): of the morphologies
        before they were scaled to a maximum of 1, where those of the profiles are 1
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    outside = unobserved(result.footprints, result.frame.shape)
    observed = ~outside[1:-1, 1:-1]
    for i, c in enumerate(result.components):
        (y, x), (n_y, n_x) = c.origin, c.morphology.shape
        beside = outside[y : y + n_y + 2, x : x + n_x + 2]  # with a pixel about the box
        if not isinstance(shapes[i], Galaxy) or not beside.any():
            continue
        (image,) = shapes[i].cut(thetas[i], positions[i], (0, 0), observed.shape, slopes=False)
        scale = max(image.max() * peaks[i], 1e-300)
        beyond = max(1 - image[observed].sum(), 0.0) / scale  # its integral is 1
        found[c.source] += c.spectrum * min(beyond, c.morphology.sum())
    return found


def widened(errors, outside):
    """Errors with the light outside of what was observed (S, C) [counts] in those of fluxes.

    It is as uncertain as it is large, and common to all channels of a source.
    """
    flux, s = errors.flux.copy(), np.arange(len(outside))
    flux[:, s, s] += outside.T**2
    colour = errors.colour + outside[:, :, None] * outside[:, None, :]
    return replace(errors, flux=flux, colour=colour, outside=outside)


def reaches_outside(errors, flux, part):
    """Which sources (S,) have more light outside than their flux (S, C) is uncertain without it, and
    more than a part of it, in some channel."""
    if errors.outside is None:
        return np.zeros(len(flux), bool)
    variance = np.diagonal(errors.flux, axis1=1, axis2=2).T  # that of the light outside is in it
    more = errors.outside**2 > variance / 2
    return (more & (errors.outside > part * flux)).any(axis=1)
