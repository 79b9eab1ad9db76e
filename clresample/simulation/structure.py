"""Galaxies of several parts with spectra of their own: bulge, bar, disk, spiral arms, clumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .counts import half_light_arcsec, is_elliptical, sersic_index
from .galaxies import BULGE_CUT, import_galsim

# Spectral indices of f_nu ~ wavelength^index relative to the galaxy's: bulges and bars are old and
# red, arms and clumps young and blue, by half a magnitude of g - i in either direction.
BULGE_INDEX, ARM_INDEX, CLUMP_INDEX = 0.8, -0.5, -1.2
ARM_STEPS = 18  # Gaussians along one arm, half of their width apart at its outer end
ARM_TURNS = 0.75  # turns of an arm from 0.6 to 2.2 half-light radii
# [arcsec] half-light radius from which a galaxy shows bars and arms: smaller ones are blurred
MIN_ARMS_ARCSEC = 0.8
CLUMP_SIZE = (0.02, 0.08)  # Gaussian sigma of clumps in half-light radii of their galaxy


@dataclass(frozen=True, eq=False)
class LightPart:
    """One part of a source: a GalSim profile of unit flux with a spectrum.

    fraction: of the source's light in i; index: of its spectrum f_nu ~ wavelength^index
    clumps_arcsec (k, 2) [arcsec]: (y, x) about the source's centre of the clumps that this part is
        made of, and clump_fractions (k,): of the part's light; empty for smooth parts
    """

    profile: object
    fraction: float
    index: float
    clumps_arcsec: np.ndarray
    clump_fractions: np.ndarray


@dataclass(frozen=True, eq=False)
class SkySource:
    """A galaxy or star: parts, position (2,) [arcsec], i magnitude, kind, host's number or -1.

    size_arcsec [arcsec], n: half-light radius and Sersic index of the widest part, 0 of a star
    """

    parts: tuple[LightPart, ...]
    position: np.ndarray
    mag_i: float
    kind: str
    host: int = -1
    size_arcsec: float = 0.0
    n: float = 0.0


def smooth_part(profile, fraction, index) -> LightPart:
    """A LightPart without clumps."""
    return LightPart(profile, fraction, index, np.zeros((0, 2)), np.zeros(0))


def star_parts(index) -> tuple[LightPart, ...]:
    """The parts of a star."""
    return (smooth_part(import_galsim().DeltaFunction(), 1.0, index),)


def elliptical_parts(rng, size, n, index) -> tuple[LightPart, ...]:
    """The parts of an elliptical: one Sersic profile; size [arcsec]: half-light radius."""
    galsim = import_galsim()
    profile = galsim.Sersic(n, half_light_radius=size, trunc=BULGE_CUT * size)
    profile = profile.shear(q=rng.uniform(0.5, 1.0), beta=_angle(rng))
    return (smooth_part(profile, 1.0, index),)


def disk_parts(
    rng, size, index, *, n=1.0, n_knots=None, knots=(0.03, 0.2)
) -> tuple[LightPart, ...]:
    """The parts of a disk galaxy.

    size [arcsec]: half-light radius of the disk; n: its Sersic index; n_knots: number of clumps,
        None = more in larger disks; knots: range of their fraction of the light. Large disks have
        bars and arms
    """
    galsim = import_galsim()
    ratio, angle = rng.uniform(0.3, 1.0), _angle(rng)
    turned = _Disk(size, ratio, angle)
    grand = size > MIN_ARMS_ARCSEC and n_knots is None
    disk = galsim.Sersic(n, half_light_radius=size, trunc=BULGE_CUT * size if n > 1.5 else 0)
    left, parts = 1.0, []
    bulge = rng.uniform(0.0, 0.3)
    if n_knots is None and bulge > 0.02:
        profile = galsim.Sersic(
            min(4.0, 1 + 10 * bulge), half_light_radius=0.2 * size, trunc=BULGE_CUT * 0.2 * size
        ).shear(q=np.sqrt(ratio), beta=angle)
        parts.append(smooth_part(profile, bulge, index + BULGE_INDEX))
        left -= bulge
    if grand and rng.uniform() < 0.5:
        bar = galsim.Sersic(0.7, half_light_radius=0.35 * size).shear(q=0.3, beta=_angle(rng))
        parts.append(smooth_part(turned.inclined(bar), 0.1, index + BULGE_INDEX))
        left -= 0.1
    arms = None
    if grand:
        arms, fraction = _arms(rng, turned), rng.uniform(0.1, 0.3) * left
        profile = turned.inclined(_gaussians(*arms))
        parts.append(smooth_part(profile, fraction, index + ARM_INDEX))
        left -= fraction
    if n_knots is None:
        n_knots = int(np.clip(rng.poisson(4 + 12 * size), 2, 60))
    fraction = rng.uniform(*knots) * left
    parts.append(_clumps(rng, turned, n_knots, fraction, index + CLUMP_INDEX, arms))
    profile = disk.shear(q=ratio, beta=angle)
    return (smooth_part(profile, left - fraction, index), *parts)


def galaxy_parts(rng, magnitude, size, disk_index, red_index):
    """The parts and Sersic index of a galaxy of an i magnitude and half-light radius [arcsec].

    disk_index, red_index: mean and standard deviation of spectral indices of disks and ellipticals
    """
    if is_elliptical(rng, magnitude):
        n = sersic_index(rng, magnitude)
        return elliptical_parts(rng, size, n, rng.normal(*red_index)), n
    return disk_parts(rng, size, rng.normal(*disk_index)), 1.0


def real_galaxy(rng, magnitude, max_size_arcsec):
    """A galaxy of a real sky as a GalSim object of unit flux, of one spectrum, for an i magnitude.

    max_size_arcsec [arcsec]: largest half-light radius
    """
    size = min(half_light_arcsec(rng, magnitude), max_size_arcsec)
    parts, _ = galaxy_parts(rng, magnitude, size, (0, 0), (0, 0))
    return import_galsim().Add([part.fraction * part.profile for part in parts])


@dataclass(frozen=True)
class _Disk:
    """A thin disk's half-light radius [arcsec], axis ratio and position angle."""

    size: float
    ratio: float
    angle: object

    def inclined(self, profile):
        """A profile of the disk's plane as it is projected on the sky."""
        return profile.shear(q=self.ratio, beta=self.angle)

    def projected(self, places):
        """Positions (k, 2) [arcsec] (y, x) in the plane, on the sky."""
        galsim = import_galsim()
        (a, b), (c, d) = galsim.Shear(q=self.ratio, beta=self.angle).getMatrix()  # of (x, y)
        y, x = np.asarray(places).T
        return np.stack([c * x + d * y, a * x + b * y], axis=1)


def _angle(rng):
    return rng.uniform(0, 180) * import_galsim().degrees


def _arms(rng, disk):
    """Positions (k, 2) [arcsec], widths (k,) [arcsec] and fluxes (k,) along logarithmic spirals."""
    n_arms, hand = int(rng.integers(2, 5)), rng.choice([-1, 1])
    along = np.linspace(0, 1, ARM_STEPS)
    radius = disk.size * 0.6 * (2.2 / 0.6) ** along
    first = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(n_arms)[:, None] / n_arms
    turn = first + hand * 2 * np.pi * ARM_TURNS * along
    places = np.stack([radius * np.sin(turn), radius * np.cos(turn)], axis=-1).reshape(-1, 2)
    flux = np.broadcast_to(radius**2 * np.exp(-1.678 * radius / disk.size), turn.shape).ravel()
    width = np.broadcast_to(0.12 * radius, turn.shape).ravel()
    return places, width, flux / flux.sum()


def _gaussians(places, widths, fluxes):
    """Gaussians of widths (k,) [arcsec] at positions (k, 2) [arcsec] added up, of unit flux."""
    galsim = import_galsim()
    return galsim.Add(
        [
            galsim.Gaussian(sigma=float(w), flux=float(f)).shift(float(x), float(y))
            for (y, x), w, f in zip(places, widths, fluxes, strict=True)
        ]
    )


def _clumps(rng, disk, n, fraction, index, arms):
    """The LightPart of n clumps on the arms, or distributed as the disk's light if it has none.

    Their fluxes follow N(>f) ~ 1 / f, as of luminosities of HII regions, Kennicutt et al. 1989
    (ApJ 337, 761), over a factor of 20.
    """
    if arms is None:
        scale = disk.size / 1.678
        radius, turn = scale * rng.gamma(2, 1, n), rng.uniform(0, 2 * np.pi, n)
        plane = np.stack([radius * np.sin(turn), radius * np.cos(turn)], axis=1)
    else:
        places, width, flux = arms
        chosen = rng.choice(len(places), n, p=flux)
        plane = places[chosen] + 0.5 * width[chosen, None] * rng.standard_normal((n, 2))
    flux = 1 / rng.uniform(0.05, 1, n)
    flux /= flux.sum()
    widths = disk.size * rng.uniform(*CLUMP_SIZE, n)
    places = disk.projected(plane)
    return LightPart(_gaussians(places, widths, flux), fraction, index, places, flux)
