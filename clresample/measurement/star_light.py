"""Removes the light of saturated stars from signal-to-noise images.

The light of such a star differs from the model PSF: wings beyond the PSF image, diffraction spikes,
ghosts. It still changes slowly along rays from the star. The light above the median of each ring is
opened morphologically along every ray, so that light that extends over more than a source's width
is attributed to the star:

m(r) = max over windows of length L that contain r of the minimum in the window.

A star's light falls outwards. So m(r) is at most `MAX_RISE` times the least m nearer to the star,
each with `UNEVEN` of its ring's light, and `RISE_SIGMAS` more: the light of a large galaxy that
lies beyond a darker stretch stays.

The remainder of the image is searched, in units of its scatter on the same ring.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import (
    grey_dilation,
    grey_erosion,
    map_coordinates,
    maximum_filter1d,
    median_filter,
)

from ..deblending.inspection.image import brightness, typical_sigma
from ..deblending.inspection.psf_samples import inscribed_radius, ring_mean
from ..deblending.inspection.spoilt import saturated_pixels
from ..deblending.inspection.star_cores import MAX_FLATTER, star_cores
from ..deblending.inspection.star_profile import RadialProfile
from ..sky.psf import SIGMAS_A_FWHM
from .signal_to_noise import WIDTHS_ARCSEC, SignalToNoise

# [FWHM of the filtered image] Length L: a source is narrower along every ray.
SOURCE_FWHM = 3.0
# [sigma] Median light of a ring over the least of any, where that of the star has ended; rings
# count of which this part was seen.
END_SIGMAS, MIN_COVERED_FRACTION = 0.5, 0.25
SPIKE_REACH = 2.0  # [radii of that ring] radius up to which spikes are removed
MAX_RISE, RISE_SIGMAS = 1.5, 1.0  # [1], [sigma] of the opened light outwards along a ray
# [1] of a ring's light and of the opened light: their fluctuation along a ray. With 0.01 of a
# ring's light, a star in DECam images has four false sources, with 0.03 and 0.1 none.
UNEVEN = 0.1
# Light alternates along the rows and columns through a core that is smaller than the PSF. Pixels
# count as dark if a ray has depths of the first number [sigma] below its median beside them, and
# they are below the second number times that depth. Of 24 peaks along those lines in `simulate
# field --sky bright`, seeds 2 and 3, one is left, and so are all true sources.
MIN_DIP_SIGMAS, MIN_OVER_DIP = 2.0, 3.0
MAX_REACH_PX = 300  # [model px] largest radius from which light is removed; it is faint beyond
MIN_SEEN_WEIGHT = 0.99  # [1] of the weights of interpolation between pixels
# [FWHM of a filtered point] Pixels nearer to the core's edge have no peaks of their own.
MIN_CORE_DISTANCE_FWHM = 1.0
# [FWHM of the PSF] Cores of several images nearer than this, and than their radius, are one star's.
SAME_STAR_FWHM = 1.0
# [sigma] Smallest light in another channel that tells a star from a gap.
MIN_POINT_SIGMAS = 10.0
# Median |x| of a unit Gaussian, inverted.
SIGMAS_A_MAD = 1.4826


@dataclass(frozen=True, eq=False)
class StarPlace:
    """A star with a saturated core: its place (2,) [model px] and the core's radius [model px]."""

    place: np.ndarray
    radius: float


def saturated_stars(observations, frame) -> list[StarPlace]:
    """Finds stars with a saturated or masked core in any channel, the brightest first.

    observations: of any kind; frame: Frame of the pixels in which their places are returned
    """
    found = []
    for o in observations:
        usable = o.weights > 0
        significance = np.where(usable, o.data * np.sqrt(o.weights), 0)
        usable = usable & ~saturated_pixels(o, significance, usable)
        light = brightness(o.data, usable, typical_sigma(o.weights))
        scale = o.grid.pixel_scale_arcsec / frame.grid.pixel_scale_arcsec
        for c, fwhm in enumerate(o.psf.fwhm_px):
            for core in star_cores(light[c], usable[c], o.psf, c):
                if _is_gap(light, usable, o.psf, c, core):
                    continue
                place = o.grid.positions_in(frame.grid, *core.place)
                found.append((core.light, fwhm * scale, StarPlace(place, core.radius * scale)))
    return _merged(found)


def _is_gap(light, usable, psf, c, core):
    """Returns True if a core of channel c is a gap over a galaxy, by the other channels.

    By the brightest one in which all of it is seen: there a star is a point.
    light, usable (C, My, Mx): of all channels, see `star_cores`
    """
    radius = max(core.radius, float(psf.fwhm_px.max()))
    low = np.maximum(np.floor(core.place - radius - 2).astype(int), 0)
    window = tuple(slice(a, int(b + radius + 3)) for a, b in zip(low, core.place, strict=True))
    light, usable = light[:, *window], usable[:, *window]
    away = np.hypot(*(np.indices(light.shape[1:]) + (low - core.place)[:, None, None]))
    disc, middle = away < radius + 1, away < away.min() + 0.5
    seen = [k for k in range(len(light)) if k != c and usable[k][disc].all()]
    peak, k = max(((float(light[k][middle].max()), k) for k in seen), default=(0.0, c))
    if peak < MIN_POINT_SIGMAS or radius > inscribed_radius(psf, k):
        return False
    point = peak * ring_mean(psf, k, radius) / ring_mean(psf, k, 0.0)
    ring = light[k][np.abs(away - radius) < 1]
    return bool(np.median(ring) > MAX_FLATTER * max(point, 0.0) + 1)


def _merged(found):
    """Merges cores (light, FWHM, StarPlace) of the same star at their median place."""
    stars: list[list] = []
    for _, fwhm, star in sorted(found, key=lambda one: -one[0]):
        for group in stars:
            first = group[0]
            near = max(SAME_STAR_FWHM * fwhm, first.radius, star.radius)
            if np.hypot(*(first.place - star.place)) < near:
                group.append(star)
                break
        else:
            stars.append([star])
    return [
        StarPlace(np.median([s.place for s in group], axis=0), max(s.radius for s in group))
        for group in stars
    ]


def peak_beside(image, star) -> float:
    """Brightest pixel of an image (Ny, Nx) within two radii of a star's core."""
    n_y, n_x = image.shape
    away = np.hypot(np.arange(n_y)[:, None] - star.place[0], np.arange(n_x) - star.place[1])
    return float(image[away < 2 * star.radius + 1].max(initial=0.0))


def remove_star_light(signal, stars, fwhm_px, pixel_arcsec) -> SignalToNoise:
    """Removes the light of StarPlaces from a signal, in units of its scatter there.

    Sums of squares are left out there, because such light adds to every channel.
    fwhm_px [px]: of the PSF; pixel_arcsec [arcsec]: side of a pixel
    """
    if not stars:
        return signal
    sums, squares, seen = signal.sums.copy(), signal.squares.copy(), signal.measured
    root = np.sqrt(np.maximum(signal.n_seen, 1))
    for w, sigma in enumerate(WIDTHS_ARCSEC):
        # of the PSF filtered with itself and twice with the Gaussian
        wide = SIGMAS_A_FWHM * sigma / pixel_arcsec
        point_px = np.sqrt(2) * np.hypot(fwhm_px, wide)
        rest, held = _without_stars(signal.flat(w), seen, stars, point_px)
        sums[w] = np.where(held, rest * root, sums[w])
        squares[w][held] = 0
    return replace(signal, sums=sums, squares=squares)


def _without_stars(image, seen, stars, fwhm):
    """Removes the light of StarPlaces from an image (Ny, Nx) [sigma].

    Also returns the pixels (Ny, Nx) bool from which light was removed.

    seen (Ny, Nx): bool, pixels whose light is measured; others near a star have none afterwards
    fwhm [px]: of a point source in the image
    """
    rest, held = image, np.zeros(image.shape, bool)
    for star in stars:
        rest, own = _without(rest, seen, star, fwhm)
        held |= own
    return rest, held


def _without(image, seen, star, fwhm):
    """Removes the light of one star within the window that it may reach.

    Arguments and results are those of `_without_stars`.
    """
    at, shape = np.rint(star.place).astype(int), np.array(image.shape)
    low, high = np.clip(at - MAX_REACH_PX, 0, shape), np.clip(at + MAX_REACH_PX + 1, 0, shape)
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    moved = StarPlace(star.place - low, star.radius)
    rest, held = image.copy(), np.zeros(image.shape, bool)
    rest[window], held[window] = _in_window(image[window], seen[window], moved, fwhm)
    return rest, held


def _in_window(image, seen, star, fwhm):
    n_y, n_x = image.shape
    dy, dx = np.arange(n_y)[:, None] - star.place[0], np.arange(n_x) - star.place[1]
    away = np.hypot(dy, dx)
    rings = np.rint(away).astype(int)
    end = _end(image, seen, rings, int(star.radius))
    reached = away < end
    own = reached & seen
    if not own.any():
        return image, own
    n_angles = int(np.ceil(2 * np.pi * end))
    angles = np.arange(n_angles) * 2 * np.pi / n_angles
    radii, length = np.arange(end + 1.0)[:, None], int(np.ceil(SOURCE_FWHM * fwhm))
    at = [star.place[0] + radii * np.sin(angles), star.place[1] + radii * np.cos(angles)]
    profile = RadialProfile.measure(image, own & (away >= star.radius), away, 1.0)
    mean = profile.at(away) if profile else np.zeros(image.shape)
    on_rings = profile.at(radii[:, 0]) if profile else np.zeros(len(radii))
    on_rings[: int(star.radius) + 1] = np.inf
    rays = map_coordinates(np.where(seen, image - mean, 0), at, order=1, mode="nearest")
    rays[
        map_coordinates(seen.astype(np.float32), at, order=1, mode="nearest") < MIN_SEEN_WEIGHT
    ] = np.inf
    turn = np.arctan2(dy, dx) / (2 * np.pi) * n_angles % n_angles
    model, dips = (
        map_coordinates(
            np.concatenate([a, a[:, :1]], axis=1), [np.minimum(away, end), turn], order=1
        )
        for a in (_falling(_opened(rays, length), on_rings), _dips(rays, length))
    )
    left = np.where(own, image - mean - model, 0.0)
    middle, spread = _statistics(left[own], rings[own], end)
    noise = np.hypot(spread[np.minimum(rings, end)], UNEVEN * (mean + model))
    left = (left - middle[np.minimum(rings, end)]) / noise
    dips /= noise
    left[(dips > MIN_DIP_SIGMAS) & (left < MIN_OVER_DIP * dips)] = 0  # alternating pixels
    left[away < star.radius + MIN_CORE_DISTANCE_FWHM * fwhm] = 0
    return np.where(reached, left, image).astype(image.dtype), reached


def _opened(rays, length):
    """Morphological opening of rays (radii, angles) over a length [px]; infinite if not seen."""
    size = (length, 1)
    least = grey_erosion(rays, size=size, mode="nearest")
    found = grey_dilation(np.where(np.isfinite(least), least, -np.inf), size=size, mode="nearest")
    return np.where(np.isfinite(found), found, np.inf)


def _falling(rays, on_rings):
    """Opened rays (radii, angles) as far as they are a star's light, 0 where they are infinite.

    on_rings (radii,): light of the rings, infinite in the core
    """
    error = UNEVEN * on_rings[:, None]
    least = np.minimum.accumulate(np.maximum(rays, 0) + error, axis=0)
    found = np.minimum(rays, MAX_RISE * least + RISE_SIGMAS)
    return np.where(np.isfinite(rays), found, 0.0)


def _dips(rays, length):
    """Largest depth of rays (radii, angles) below their median within a length [px]."""
    light = np.where(np.isfinite(rays), rays, 0.0)
    depth = np.where(
        np.isfinite(rays), median_filter(light, size=(length, 1), mode="nearest") - light, 0.0
    )
    return maximum_filter1d(depth, length, axis=0, mode="nearest")


def _end(image, seen, rings, first):
    """Radius [px] beyond which the median light of rings (Ny, Nx) no longer falls."""
    order = np.argsort(rings[seen], kind="stable")
    number, values = rings[seen][order], image[seen][order]
    starts = np.searchsorted(number, np.arange(number[-1] + 2 if len(number) else 1))
    light = np.full(len(starts) - 1, np.inf)
    for r in range(first, len(light)):
        part = values[starts[r] : starts[r + 1]]
        if len(part) > MIN_COVERED_FRACTION * 2 * np.pi * r:
            light[r] = np.median(part)
    if not np.isfinite(light).any():
        return len(light)
    end = int(np.argmax(light < light.min() + END_SIGMAS))
    return int(SPIKE_REACH * end)


def _statistics(values, rings, end):
    """Median and scatter (at least 1) of values on rings, each (end + 1,)."""
    middle, spread = np.zeros(end + 1), np.ones(end + 1)
    order = np.argsort(rings, kind="stable")
    number, values = rings[order], values[order]
    starts = np.searchsorted(number, np.arange(end + 2))
    for r in range(end + 1):
        # three rings, so that the innermost hold enough pixels
        part = values[starts[max(r - 1, 0)] : starts[min(r + 2, end + 1)]]
        if len(part):
            middle[r] = np.median(part)
            spread[r] = max(1.0, SIGMAS_A_MAD * np.median(np.abs(part - middle[r])))
    return middle, spread
