"""Finds neighbours on the flanks of brighter sources by their asymmetry.

A galaxy's light is much the same on both sides of its centre and falls outwards, a neighbour's is
on one side. So the least light that a source has on each ring and on both sides,

    m(r, t) = min over r' <= r of min(I(r', t), I(r', t + pi)),

is its symmetric model, and the image minus the sum of all these models is searched. A residual peak
may also be a clump of the galaxy itself. Two criteria distinguish them: clumps lie on the galaxy's
light, and have its colours. A peak h is a source of its own if

    h >= c(r) sqrt(H (m + 1)),   or   h >= CLUMP_PART F max(1, MAX_BY_CHANCE / n(r)),
    or   h >= COLOURED sqrt(H (m + 1)) and its spectrum is another

where H is the galaxy's peak, m its light there and F all of its light as the peak of a point, all
in sigma, r is the distance from its centre, n the number of sources within it by chance (clumps.py)
and c(r) = CLUMP r / CLUMP_ARCSEC, limited to MIN_CLUMP and MAX_CLUMP. If a clump's light were a
fraction of the galaxy's, the threshold would scale with H; if it were a fraction of the local
light, with m. The mean of both, sqrt(H m), separates neighbours from clumps better than either.
c(r) grows outwards: near the centre the symmetric model contains part of the neighbour, so that
less of it is left; far out a single clump, whose opposite side is empty, is left whole. The second
condition counts under wide PSFs, where F is a few H and neighbours are seen at distances at which
they are more frequent than clumps: without it a neighbour of a fifth of the light of a galaxy of
signal to noise 300 is first found at 3 PSF widths, with it at 1.9. Galaxies are also wider
than clumps, so a neighbour must also be left under the filter of small galaxies.

Source: the symmetry, Lupton et al. 2005 (SDSS's deblender) and Melchior et al. 2018 (Astronomy and
Computing 24, 129).
"""

from __future__ import annotations

import numpy as np

from .clumps import CHANCE, CLUMP_PART, MAX_BY_CHANCE
from .peaks import POINT_AREA

# Chosen on forty simulated fields of 1024 pixels (4000 sources); results on other fields are in
# docs/fields.md. With larger values neighbours are lost, with smaller ones clumps become sources.
CLUMP, MIN_CLUMP, MAX_CLUMP, COLOURED = 0.45, 0.15, 0.75, 0.15
# [arcsec] Distance from a galaxy's centre at which c(r) is CLUMP: three half-light radii of a
# typical galaxy in deep images. A larger value finds more neighbours and more clumps.
CLUMP_ARCSEC = 0.8
# [sigma^2] Smallest excess of chi2 between a residual's spectrum and the galaxy's; and the relative
# error of the galaxy's model in each channel.
OTHER_COLOUR, MODEL_PART = 8.0, 0.1
# The same of a peak that only its colour tells from structure, in images of less resolution. With 8
# there are 2 more false sources among 514 of simulated fields, and no more true ones.
CLEAR_COLOUR = 25.0
# [1] of the galaxy's light in the searched image: residual of a smooth, symmetric galaxy
ASYMMETRY = 0.05
# [sigma] Smallest height of a peak, and its height under the filter of small galaxies. They are
# high because the noise of both sides enters and many positions are tested.
MIN_PEAK_SIGMA, MIN_WIDE = 5.0, 6.0
# [FWHM] Radius within which the level of the residual is measured: wings of large galaxies, beyond
# REACH_PX, are left in it.
LEVEL_FWHM = 6.0
REACH_PX, N_ANGLES = 60, 32  # radius and number of rays of a source's symmetric model
MIN_LIGHT = 0.5  # [sigma] where a source's own light ends
UNSEEN = 1e30  # [sigma] value of unobserved pixels: the minimum is then that of the other side


def symmetric_residual(image, seen, positions):
    """Residual of an image after symmetric models of sources, their sum, and the light of each.

    The first two are images (Ny, Nx) [sigma], the light (S,) sums of them.

    image (Ny, Nx) [sigma]; seen (Ny, Nx) bool; positions (S, 2) [px]: centres, to part of a pixel
    """
    from scipy.ndimage import map_coordinates

    light = np.where(seen, image, UNSEEN).astype(np.float32)
    brightest = image[seen].max(initial=0)  # interpolated beside a hole, light is up to UNSEEN
    angles = np.arange(N_ANGLES) * 2 * np.pi / N_ANGLES
    radii = np.arange(REACH_PX + 1.0)[:, None]
    total, lights = np.zeros(image.shape, np.float32), np.zeros(len(positions))
    for i, (y, x) in enumerate(positions):
        at = y + radii * np.sin(angles), x + radii * np.cos(angles)
        if seen[round(y), round(x)]:
            rings = map_coordinates(light, at, order=1, cval=UNSEEN)
            rings = np.minimum(rings, np.roll(rings, N_ANGLES // 2, axis=1))
        else:  # its centre is not known well enough: all light that falls outwards counts
            rings = map_coordinates(image, at, order=1)
        rings = np.clip(np.minimum.accumulate(rings, axis=0), 0, brightest)
        bright = np.flatnonzero((rings > MIN_LIGHT).any(axis=1))
        if not len(bright):
            continue
        reach = min(bright[-1] + 1, REACH_PX)
        low = np.maximum(np.rint([y, x]).astype(int) - reach, 0)
        high = np.minimum(np.rint([y, x]).astype(int) + reach + 1, image.shape)
        dy, dx = np.arange(low[0], high[0])[:, None] - y, np.arange(low[1], high[1]) - x
        radius = np.hypot(dy, dx)
        turn = np.arctan2(dy, dx) / (2 * np.pi) * N_ANGLES % N_ANGLES
        around = np.concatenate([rings, rings[:, :1]], axis=1)
        own = map_coordinates(around, [np.minimum(radius, REACH_PX), turn], order=1)
        own *= radius <= reach
        total[low[0] : high[0], low[1] : high[1]] += own
        lights[i] = own.sum()
    return np.where(seen, image - total, 0.0), total, lights


def residual_scatter(model):
    """Scatter (Ny, Nx) [sigma] of `symmetric_residual`: the noise of both sides, asymmetry."""
    return np.sqrt(1.0 + (model > 1) + (ASYMMETRY * model) ** 2)


def parabolic_peak(image, position):
    """Offset (2,) of a peak by parabolas through it and its neighbours, within half a pixel."""
    y, x = (int(p) for p in position)
    if not (0 < y < image.shape[0] - 1 and 0 < x < image.shape[1] - 1):
        return np.array(position, float)
    return np.array(
        [
            y + _top(*image[y - 1 : y + 2, x]),
            x + _top(*image[y, x - 1 : x + 2]),
        ]
    )


def _top(before, at, after):
    curved = before - 2 * at + after
    return 0.0 if curved >= 0 else float(np.clip(0.5 * (before - after) / curved, -0.5, 0.5))


def brightest_peak_near(rest, place, radius):
    """Position (2,) and height of the brightest that is left within `radius` [px] of a peak.

    Peaks are found in units of `residual_scatter`, which increases towards the brighter source.
    So they lie about a pixel outwards of the maximum of the light.
    """
    low = np.maximum(np.asarray(place) - radius, 0)
    window = rest[low[0] : place[0] + radius + 1, low[1] : place[1] + radius + 1]
    top = low + np.unravel_index(window.argmax(), window.shape)
    return parabolic_peak(rest, top), float(rest[tuple(top)])


def local_level(rest, place, radius):
    """Median [sigma], at least 0, of what is left within `radius` [px] of a peak."""
    low = np.maximum(np.asarray(place) - radius, 0)
    window = rest[low[0] : place[0] + radius + 1, low[1] : place[1] + radius + 1]
    return max(float(np.median(window)), 0.0)


def is_a_source(
    place, height, model, lights, image, signals, centres, fwhm, scale, *, coloured=False
):
    """Returns True if a residual peak is a source of its own, by this module's criteria.

    place (2,) ints: (y, x) of the peak; height [sigma]: of the residual there, from
        `brightest_peak_near`
    model, lights, image: models (Ny, Nx) [sigma] together, the sum (S,) of each; what was searched
    signals: SignalToNoise of each observation; centres (S, 2) [px]: of the sources
    fwhm [px]: of the searched image's PSF; scale [arcsec]: of a pixel
    coloured: its spectrum must be another
    """
    at = tuple(place)
    inside = np.clip(np.rint(centres).astype(int), 0, np.array(image.shape) - 1)
    heights = np.maximum(image[inside[:, 0], inside[:, 1]], 1e-3)
    away = np.hypot(*(centres - place).T)
    host = np.argmax(np.log(heights) - away / fwhm)  # brightest if light falls by e per FWHM
    clump = np.sqrt(max(heights[host], 1.0) * (model[at] + 1))
    distance = away[host] * scale
    most = np.clip(CLUMP * distance / CLUMP_ARCSEC, MIN_CLUMP, MAX_CLUMP) * clump
    by_chance = max(CHANCE * np.pi * distance**2, 1e-9)
    part = CLUMP_PART * max(1.0, MAX_BY_CHANCE / by_chance)
    # at least that of a point, as of a source that this image hardly shows
    light = max(lights[host] / (POINT_AREA * fwhm**2), heights[host], model[at])
    if not coloured and height >= min(most, part * light):
        return True
    if height < COLOURED * clump:
        return False
    # within one observation, of one PSF or nearly so: a clump is more compact than its galaxy
    near = centres[away < REACH_PX]
    differs = sum(
        _other_colour(at, s.spectra, near, inside[host]) for s in signals if len(s.channels) > 1
    )
    return bool(differs > (CLEAR_COLOUR if coloured else OTHER_COLOUR))


def _other_colour(at, spectra, centres, host):
    """chi2, beyond its mean, of a colour at a residual pixel unlike that of its source.

    In one observation: `spectra` of its SignalToNoise.
    """
    light = sum(_light_at(at, spectra, centre) for centre in centres)
    noise = np.sqrt(2 + (MODEL_PART * light) ** 2)
    here, there = spectra(np.array([at, host]))
    rest, like = (here - light) / noise, there / noise
    along = like @ rest
    return rest @ rest - along**2 / max(like @ like, 1e-12) - (len(rest) - 1)


def _light_at(at, spectra, centre):
    """A source's own light (C,) at a pixel, by the same rule along the line from its centre."""
    step = np.array(at) - centre
    n = int(np.ceil(np.hypot(*step))) + 1
    along = np.linspace(0, 1, n)[:, None] * step
    both = [spectra(np.rint(centre + side * along).astype(int)) for side in (1, -1)]
    return np.maximum(np.minimum(*both).min(axis=0), 0)
