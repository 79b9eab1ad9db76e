"""Masks cosmic rays and hot pixels before sources are detected, so that none is taken for one.

Light sharper than the PSF permits is a ray, or a star under a PSF that is far too wide. A star
shines in other channels too: light that is sharp in one channel, where another one is observed and
has no peak, is a ray.
"""

from __future__ import annotations

import numpy as np

from ...sky.observation import masked
from .image import InspectedImage
from .spoilt import grown, sharper_than_psf

# [sigma] of the light in a box of BOX_PX about a place, above the level around it, from which a
# channel has a peak there. [px] half-width of the box; [FWHM] radii of the ring of the level.
PEAK_SIGMAS, BOX_PX, RING_FWHM = 5.0, 1, (1.5, 3.0)


def without_rays(observations, frame) -> tuple:
    """The observations with the rays masked that only one of their channels shows.

    Observations without any are returned as they are, and so is the only channel of all.
    """
    if sum(len(o.channels) for o in observations) < 2:
        return tuple(observations)
    images = [InspectedImage.of(o, frame, np.empty((0, 2)), np.zeros(2)) for o in observations]
    found = []
    for image in images:
        sharp = sharper_than_psf(image)
        rays = np.zeros_like(sharp)
        for c, y, x in np.argwhere(sharp):
            place = image.in_model(np.array([y, x]))
            peaks = [
                _has_peak(other, band, other.matrix @ place + other.offset)
                for other in images
                for band in range(len(other.usable))
                if other is not image or band != c
            ]
            rays[c, y, x] = False in peaks and True not in peaks
        o = image.observation
        found.append(masked(o, grown(rays) & image.usable) if rays.any() else o)
    return tuple(found)


def _has_peak(image, c, place):
    """Returns True if a channel of an InspectedImage has a peak at a place (2,) [px].

    None if the place is not observed.
    """
    reach = RING_FWHM[1] * image.width_px
    low = np.maximum(np.floor(place - reach).astype(int), 0)
    high = np.ceil(place + reach).astype(int) + 1
    window = tuple(slice(a, max(b, a)) for a, b in zip(low, high, strict=True))
    z, usable = image.significance[c, *window], image.usable[c, *window]
    away = np.indices(z.shape) + (low - place)[:, None, None]
    box = usable & (np.abs(away) <= BOX_PX + 0.5).all(axis=0)
    radius = np.hypot(*away)
    ring = usable & (radius > RING_FWHM[0] * image.width_px) & (radius < reach)
    if not box.any() or not ring.any():
        return None
    return bool((z[box] - np.median(z[ring])).sum() > PEAK_SIGMAS * np.sqrt(box.sum()))
