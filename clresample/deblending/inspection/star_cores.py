"""Finds stars with a saturated or masked core by the light around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    distance_transform_edt,
    find_objects,
    label,
)
from scipy.optimize import minimize

from .psf_samples import inscribed_radius, ring_mean

# [FWHM of the PSF] Smallest radius of the largest disc inside the masked pixels of a core: narrower
# masks are bad columns and cosmic rays.
MIN_RADIUS_FWHM = 0.35
# [sigma] Smallest light of a pixel beside a core: detectors saturate at 1e3 sigma, 1 to 2 px
# inwards.
MIN_EDGE_SIGMAS = 20.0
# [sigma] The same for narrower cores of 2 x 2 px and more, of stars that hardly saturate: few
# galaxies under a masked cosmic ray are as bright. With it the saturated star of `simulate field
# --sky bright` is a point in all of seeds 1 - 5, in 3 of them without it.
MIN_NARROW_EDGE_SIGMAS = 1000.0
# [FWHM] Width of the ring beside a core in which the star's light is compared with the PSF.
RING_FWHM = 1.5
# Smallest number of pixels of that ring with a weight, and of its quarters that contain them.
MIN_RING_PIXELS, MIN_QUARTERS = 12, 3
# Largest ratio of outer to inner light in the ring, in units of the PSF's ratio: PSFs are uncertain
# in their wings. A galaxy has a larger ratio.
MAX_FLATTER = 2.0
# [FWHM] Smallest half side of a PSF image that has wings: exponential galaxies with masked centres
# fall like the cores of smaller ones (tests/measurement/test_saturated_stars.py).
MIN_WINGS_FWHM = 2.0
# [e-foldings] Largest mean deviation of the ring's light from its value at each radius: stars have
# that of spikes, of diffraction rings and of the PSF's ellipticity.
MAX_SCATTER = 0.65


@dataclass(frozen=True, eq=False)
class StarCore:
    """A star with a masked core in one channel of an image.

    place (2,) [px]: (y, x) of the star; radius [px]: beyond it, the light is unmasked in most
        directions; light [sigma]: of a pixel at that radius; masked (My, Mx): bool, the core with
        its bleed trails
    """

    place: np.ndarray
    radius: float
    light: float
    masked: np.ndarray

    def grown(self, brightness, usable, margin):
        """The masked pixels (My, Mx), grown by a margin [px] as far as the star's light allows.

        They grow by whole pixels while the light beside them remains that of a core.
        brightness, usable: see `star_cores`
        """
        grown = self.masked
        for _ in range(margin):
            wider = binary_dilation(grown, np.ones((3, 3), bool))
            if _brightest_beside(brightness, usable & ~wider, wider) < MIN_EDGE_SIGMAS:
                break
            grown = wider
        return grown


def star_cores(brightness, usable, psf, band) -> list[StarCore]:
    """Finds the stars with a masked core in a channel, the brightest first.

    brightness (My, Mx) [sigma of a typical pixel]: data, 0 where not usable; usable (My, Mx): bool,
    pixels with a weight that are not saturated; psf: PSF; band: number of its band
    """
    fwhm = float(psf.fwhm_px[band])
    depth = distance_transform_edt(np.pad(~usable, 1, mode="edge"))[1:-1, 1:-1]
    deep = depth > max(MIN_RADIUS_FWHM * fwhm, 1.0)
    blocks = binary_opening(~usable, np.ones((2, 2), bool))
    if not blocks.any():
        return []
    groups, _ = label(~usable, np.ones((3, 3), bool))
    found = []
    reach = int(np.ceil(RING_FWHM * fwhm)) + 2
    for k, window in enumerate(find_objects(groups), start=1):
        own = groups[window] == k
        if not (blocks[window] & own).any():
            continue
        least = MIN_EDGE_SIGMAS if (deep[window] & own).any() else MIN_NARROW_EDGE_SIGMAS
        window = tuple(slice(max(s.start - reach, 0), s.stop + reach) for s in window)
        own, light = groups[window] == k, brightness[window]
        if not _brightest_beside(light, usable[window], own) >= least:
            continue
        core = _core(light, usable[window], own, psf, band, fwhm)
        if core is not None:
            y0, x0 = (s.start for s in window)
            place = core.place + (y0, x0)
            found.append(replace(core, place=place, masked=groups == k))
    return sorted(found, key=lambda core: -core.light)


def _brightest_beside(light, usable, masked):
    """Light [sigma] of the brightest usable pixel that touches masked pixels (My, Mx)."""
    edge = usable & binary_dilation(masked, np.ones((3, 3), bool))
    return light[edge].max(initial=0.0)


def _core(light, usable, masked, psf, band, fwhm):
    """The StarCore of one group of masked pixels (My, Mx).

    None if the light beside the group is not that of a star.
    """
    about = (_ring_about(light, usable, masked, at, fwhm) for at in _guesses(light, usable, masked))
    centred = [one for one in about if one is not None]
    if not centred:
        return None
    place, ring, inner, scatter = min(centred, key=lambda one: one[-1])
    if scatter > MAX_SCATTER or not _falls_like(light, ring, place, psf, band, fwhm):
        return None
    return StarCore(place, inner, float(np.median(light[ring])), masked)


def _guesses(light, usable, masked):
    """Two first guesses (2,) [px] of a core's place: by the light beside it, and its deepest pixel.

    Light that falls steeply is that of the side where fewest pixels are masked.
    """
    edge = usable & binary_dilation(masked, np.ones((3, 3), bool))
    y, x = np.nonzero(edge)
    weight = np.maximum(light[edge], 0) ** 2
    by_light = np.array([weight @ y, weight @ x]) / weight.sum()
    depth = distance_transform_edt(masked)
    deepest = np.argwhere(depth == depth.max())
    return by_light, deepest[np.hypot(*(deepest - by_light).T).argmin()]


def _ring_about(light, usable, masked, guess, fwhm):
    """The place (2,) [px] of a core, its ring, inner radius and scatter.

    None without a ring, and where its light is not centred on the core: it may fall to one side,
    as from a centre that is far away.
    """
    y, x = np.nonzero(masked)
    for _ in range(2):  # ring and position depend on each other
        ring, inner = _ring(usable, masked, guess, fwhm)
        if ring is None:
            return None
        guess, scatter = _centred(light, ring, guess)
        if np.hypot(y - guess[0], x - guess[1]).min() > fwhm:
            return None
    return guess, ring, inner, scatter


def _ring(usable, masked, place, fwhm):
    """Pixels (My, Mx) bool of the ring beside a core, and its inner radius [px].

    Returns (None, 0) if the ring has too few pixels.
    """
    n_y, n_x = usable.shape
    away = np.hypot(np.arange(n_y)[:, None] - place[0], np.arange(n_x) - place[1])
    own = usable & (away < 1 + _reach_of(masked, away) + RING_FWHM * fwhm)
    if own.sum() < MIN_RING_PIXELS:
        return None, 0.0
    inner = float(np.quantile(away[own], 0.02))
    ring = own & (away < inner + RING_FWHM * fwhm)
    y, x = np.nonzero(ring)
    quarters = np.unique(2 * (y > place[0]) + (x > place[1]))
    if ring.sum() < MIN_RING_PIXELS or len(quarters) < MIN_QUARTERS:
        return None, 0.0
    return ring, inner


def _reach_of(masked, away):
    """Radius [px] of the largest disc about a place that is masked."""
    return float(away[~masked].min(initial=away.max()))


def _centred(light, ring, guess):
    """Fits the centre (2,) [px] of a ring of light; also returns the scatter about it.

    The scatter is the mean deviation of the light's logarithm from a function of the radius.
    """
    y, x = np.nonzero(ring)
    value = np.log(np.maximum(light[ring], 1.0))

    def scatter(place):
        away = np.hypot(y - place[0], x - place[1])
        powers = np.vander(away - away.mean(), 3)
        return np.abs(value - powers @ np.linalg.lstsq(powers, value, rcond=None)[0]).mean()

    found = minimize(
        scatter, guess, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 1e-4, "maxiter": 80}
    )
    return found.x, float(found.fun)


def _falls_like(light, ring, place, psf, band, fwhm):
    """Returns True if the light of a ring falls outwards nearly as steeply as a PSF's."""
    y, x = np.nonzero(ring)
    away = np.hypot(y - place[0], x - place[1])
    outer = away > np.median(away)
    radii = np.array([np.median(away[~outer]), np.median(away[outer])])
    bright = np.array([np.median(light[ring][part]) for part in (~outer, outer)])
    if not (bright > 0).all():
        return False
    # beyond a large image of the PSF light is compared with that at the same ratio of radii in it
    falls, reach = bool(bright[1] < bright[0]), inscribed_radius(psf, band)
    is_large = reach >= MIN_WINGS_FWHM * fwhm
    inside = radii * min(1.0, reach / radii[1]) if is_large else radii
    own = [ring_mean(psf, band, r) for r in inside]
    if not min(own) > 0 or not (is_large or own[0] > own[1]):
        return falls
    return (is_large or falls) and bool(bright[1] / bright[0] < MAX_FLATTER * own[1] / own[0])
