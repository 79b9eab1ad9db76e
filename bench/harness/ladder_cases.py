"""Cases of bench.ladder: which sources a scene holds, drawn at random by a seed.

Sizes are half-light radii along the geometric mean of the axes [px of the finest instrument], S/N
that of the best possible filter for the whole galaxy, in all bands of all instruments together.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from clresample import ExtendedSource, PointSource
from clresample.simulation.galaxies import import_galsim, open_catalogue
from clresample.simulation.scenes import POWER_LAW_INDEX
from clresample.simulation.spoilers import COSMIC_PX, COSMIC_SIGMA

from .ladder_scenes import MODES, Item, Part, instruments, make_scene
from .options import data_folder
from .spoilt_scenes import changed

SERSIC_N = (1.0, 2.5, 4.0)
RE_PX, SNR, AXIS_RATIO = (2.0, 64.0), (10.0, 3e4), (0.2, 1.0)
BLEND_RE_PX, BLEND_SNR = (4.0, 32.0), (100.0, 1e4)
# [px] Wings are drawn to r_e times the first and the second number: beyond the frame's corners and
# the PSF of each case. Their flux beyond counts in the total.
WINGS_RE, WINGS_PX = 6.0, 64.0
NEIGHBOUR_SNR, NEIGHBOUR_RE_PX = 20.0, 2.0
NEIGHBOUR_AWAY_RE, GAP_PX = (1.0, 2.5, 4.0), 4.0  # distance: a multiple of r_e and this gap
PAIR_AWAY_RE = (0.5, 3.0)
RED_INDEX, BLUE_INDEX = 2.5, 0.0  # power laws of a bulge's and its disk's spectra
BULGE_FRACTION, BULGE_SIZE = 0.3, 0.2  # of the light in r; half-light radius in units of the disk's
GIANT_RE_PX, GIANT_SNR, N_SATELLITES = (16.0, 32.0), (1e3, 1e4), 8
SATELLITE_RE_PX, SATELLITE_SNR, SATELLITE_AWAY_RE = (1.5, 4.0), (20.0, 200.0), (0.5, 3.5)
COSMOS_TIMES = (4.0, 8.0)
N_COSMOS = 12  # galaxies of highest signal to noise, of which one is drawn
WRONG_KIND_RE_PX = (2.0, 8.0)
CLOSE_RE_PX, CLOSE_SNR, CLOSE_AWAY_PX = (1.5, 12.0), (30.0, 3e3), (0.5, 2.0)
CLOSE_RATIOS = (0.7, 1.4)  # of the two sizes, and of the two S/N
RAY_RE_PX, RAY_SNR, RAY_AWAY_PX = (1.5, 8.0), (15.0, 500.0), 1.5  # scatter of the track's middle


class Limits:
    """Values of n, re_px, snr that the caller fixes (None: drawn), and the largest r_e drawn."""

    def __init__(self, n=None, re_px=None, snr=None, largest_re_px=np.inf):
        self.n, self.re_px, self.snr, self.largest_re_px = n, re_px, snr, largest_re_px

    def size(self, rng, low, high):
        if self.re_px is not None:
            return self.re_px
        return log_uniform(rng, low, max(low, min(high, self.largest_re_px)))

    def brightness(self, rng, low, high):
        return log_uniform(rng, low, high) if self.snr is None else self.snr

    def steepness(self, rng):
        return float(rng.choice(SERSIC_N)) if self.n is None else self.n


def log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sersic(n, re_px, q, angle_deg, scale_arcsec):
    """A GalSim profile whose flux, wings to infinity included, is 1."""
    galsim, size = import_galsim(), re_px * scale_arcsec
    if n == 1:  # no wings that make drawing costly
        profile = galsim.Exponential(half_light_radius=size)
    else:
        reach_re = (WINGS_RE + WINGS_PX / re_px) / np.sqrt(q)  # on the profile before the shear
        # of few values: GalSim tabulates each one, and does not succeed with n = 4 beyond 64 r_e
        reach_re = min(2.0 ** np.ceil(np.log2(reach_re)), 64.0)
        profile = galsim.Sersic(
            n, half_light_radius=size, trunc=reach_re * size, flux_untruncated=True
        )
    return profile.shear(q=q, beta=angle_deg * galsim.degrees)


def colour(rng):
    """Index of a galaxy's power-law spectrum, scattered as in simulated scenes."""
    return rng.normal(*POWER_LAW_INDEX)


def galaxy(rng, scale, n, re_px, snr, **more):
    """An Item of one Sersic profile, of random axis ratio, angle and colour."""
    q, angle = rng.uniform(*AXIS_RATIO), rng.uniform(0, 180)
    parts = (Part(sersic(n, re_px, q, angle, scale), colour(rng)),)
    return Item(parts, snr, n, re_px, q, **more)


def away(rng, distance_px):
    angle = rng.uniform(0, 2 * np.pi)
    return distance_px * np.sin(angle), distance_px * np.cos(angle)


def single(rng, scale, limits):
    re_px, snr = limits.size(rng, *RE_PX), limits.brightness(rng, *SNR)
    return [galaxy(rng, scale, limits.steepness(rng), re_px, snr)]


def neighbour(rng, scale, limits):
    re_px, snr = limits.size(rng, *BLEND_RE_PX), limits.brightness(rng, *BLEND_SNR)
    distance = rng.choice(NEIGHBOUR_AWAY_RE) * re_px + GAP_PX
    faint = {"away_px": away(rng, distance), "role": "neighbour"}
    return [
        galaxy(rng, scale, limits.steepness(rng), re_px, snr),
        galaxy(rng, scale, 1.0, NEIGHBOUR_RE_PX, NEIGHBOUR_SNR, **faint),
    ]


def pair(rng, scale, limits):
    re_px, snr = limits.size(rng, *BLEND_RE_PX), limits.brightness(rng, *BLEND_SNR)
    place = away(rng, rng.uniform(*PAIR_AWAY_RE) * re_px)
    return [
        galaxy(rng, scale, limits.steepness(rng), re_px, snr),
        galaxy(rng, scale, limits.steepness(rng), re_px, snr, away_px=place),
    ]


def bulge_disk(rng, scale, limits):
    re_px, snr = limits.size(rng, *BLEND_RE_PX), limits.brightness(rng, *BLEND_SNR)
    q, angle = rng.uniform(*AXIS_RATIO), rng.uniform(0, 180)
    bulge = sersic(4.0, BULGE_SIZE * re_px, np.sqrt(q), angle, scale)
    parts = (
        Part(sersic(1.0, re_px, q, angle, scale), BLUE_INDEX, 1 - BULGE_FRACTION),
        Part(bulge, RED_INDEX, BULGE_FRACTION),
    )
    return [Item(parts, snr, 1.0, re_px, q)]


def giant(rng, scale, limits):
    re_px, snr = limits.size(rng, *GIANT_RE_PX), limits.brightness(rng, *GIANT_SNR)
    items = [galaxy(rng, scale, 4.0, re_px, snr)]
    for _ in range(N_SATELLITES):
        place = away(rng, rng.uniform(*SATELLITE_AWAY_RE) * re_px)
        size, bright = log_uniform(rng, *SATELLITE_RE_PX), log_uniform(rng, *SATELLITE_SNR)
        items.append(galaxy(rng, scale, 1.0, size, bright, away_px=place, role="neighbour"))
    return items


@cache
def cosmos_catalogue():
    """The open catalogue of the data folder and its best rows, or None where it is missing."""
    folder = data_folder() / "cosmos"
    if not folder.is_dir():
        return None
    galaxies = open_catalogue(folder)
    order = np.argsort(-galaxies.stamp_flux / np.sqrt(galaxies.variance), kind="stable")
    return galaxies, order[:N_COSMOS]


def cosmos(rng, scale, limits):
    galsim, (catalogue, rows) = import_galsim(), cosmos_catalogue()
    row, times = int(rng.choice(rows)), float(rng.choice(COSMOS_TIMES))
    drawn = catalogue.getGalImage(row)
    drawn.setCenter(0, 0)
    re_px = times * drawn.calculateHLR(flux=drawn.array.sum()) / scale
    profile = galsim.RealGalaxy(catalogue, index=row, flux=1.0).expand(times)
    profile = profile.rotate(rng.uniform(0, 360) * galsim.degrees)
    snr = limits.brightness(rng, *BLEND_SNR)
    return [Item((Part(profile, colour(rng)),), snr, re_px=re_px)]


def star_as_galaxy(rng, scale, limits):
    star = import_galsim().DeltaFunction()
    snr = limits.brightness(rng, *SNR)
    return [Item((Part(star, colour(rng)),), snr, role="star", fitted_as=ExtendedSource)]


def galaxy_as_point(rng, scale, limits):
    re_px, snr = limits.size(rng, *WRONG_KIND_RE_PX), limits.brightness(rng, *SNR)
    return [galaxy(rng, scale, limits.steepness(rng), re_px, snr, fitted_as=PointSource)]


def close(rng, scale, limits):
    re_px, snr = limits.size(rng, *CLOSE_RE_PX), limits.brightness(rng, *CLOSE_SNR)
    place = away(rng, rng.uniform(*CLOSE_AWAY_PX))
    other = (value * log_uniform(rng, *CLOSE_RATIOS) for value in (re_px, snr))
    return [
        galaxy(rng, scale, limits.steepness(rng), re_px, snr),
        galaxy(rng, scale, limits.steepness(rng), *other, away_px=place),
    ]


def ray(rng, scale, limits):
    re_px, snr = limits.size(rng, *RAY_RE_PX), limits.brightness(rng, *RAY_SNR)
    return [galaxy(rng, scale, limits.steepness(rng), re_px, snr)]


def with_ray(scene, rng):
    """The scene with a cosmic ray across its middle in one channel of one observation."""
    observations = list(scene.observations)
    k = int(rng.integers(len(observations)))
    o = observations[k]
    data, c = o.data.copy(), int(rng.integers(len(o.channels)))
    shape, sigma = np.array(data.shape[1:]), np.median(o.weights[c]) ** -0.5
    length, angle = rng.uniform(*COSMIC_PX), rng.uniform(0, np.pi)
    along = (np.arange(0, length, 0.7) - length / 2)[:, None] * [np.sin(angle), np.cos(angle)]
    track = np.rint((shape - 1) / 2 + rng.normal(0, RAY_AWAY_PX, 2) + along).astype(int)
    y, x = np.unique(np.clip(track, 0, shape - 1), axis=0).T
    data[c, y, x] += sigma * log_uniform(rng, *COSMIC_SIGMA) * rng.uniform(0.5, 1.5, len(y))
    observations[k] = changed(o, data=data)
    return replace(scene, observations=tuple(observations))


CASES = {
    f.__name__: f
    for f in (
        single, neighbour, pair, bulge_disk, giant, cosmos, star_as_galaxy, galaxy_as_point,
        close, ray,
    )
}  # fmt: skip


def scene_of(case, mode, seed, i, limits=None):
    """The i-th scene of a case: the same one for the same seed, whatever else is drawn."""
    rng = np.random.default_rng((seed, list(CASES).index(case), MODES.index(mode), i))
    items = CASES[case](rng, instruments(mode)[0].scale_arcsec, limits or Limits())
    scene = make_scene(mode, items, rng)
    return with_ray(scene, rng) if case == "ray" else scene
