"""Fields with large and bright sources: a real sky's, and six bright galaxies among faint ones."""

from __future__ import annotations

import numpy as np

from .counts import galaxy_magnitudes, half_light_arcsec, star_magnitudes
from .galaxies import HALF_LIGHT_ARCSEC, KNOT_FRACTION, parametric_galaxy
from .mosaicked import SimulatedField
from .painting import band_fluxes, painted
from .spoilers import Spoilers
from .structure import (
    SkySource,
    disk_parts,
    elliptical_parts,
    galaxy_parts,
    smooth_part,
    star_parts,
)
from .surveys import EUCLID_VIS

# Spectral index of f_nu ~ wavelength^index: mean, standard deviation
DISK_SPECTRUM, RED_SPECTRUM, STAR_SPECTRUM = (1.2, 0.7), (2.5, 0.3), (1.0, 1.0)
CLUSTER_ARCSEC = 1.5  # [arcsec] scatter of a companion's position about its host, in y and in x
LARGE_ARCSEC = (2.0, 20.0)  # [arcsec] half-light radii of the `n_large` galaxies
# The bright field: its galaxies' half-light radii [Euclid px], Sersic indices and magnitudes
N_BRIGHT, BRIGHT_PX, BRIGHT_N, BRIGHT_MAG = 6, (8.0, 30.0), (1.0, 4.0), (17.5, 20.5)
N_KNOTS, DISK_LIKE = 30, 1.6  # clumps of its disks; Sersic index up to which one is a disk
N_SMALL_1024, N_STARS = 160, 5  # in 1024 x 1024 px, and stars of any size of field
SMALL_MAG, STAR_MAG, SATURATED_MAG = (21.0, 26.5), (18.5, 23.0), 16.0
BRIGHT_BORDER = 0.1  # of the field's side, free of bright galaxies


def sky_sources(sky, rng, side_arcsec, **options):
    """SkySources of a "real" or "bright" sky; options: of `real_sources`."""
    if sky == "real":
        return real_sources(rng, side_arcsec, **options)
    return bright_sources(rng, side_arcsec)


def real_sources(rng, side_arcsec, *, density, faintest, clustering, stars, n_large):
    """SkySources of a real sky in a square of this side [arcsec]; see `simulate_field`."""
    area = (side_arcsec / 60) ** 2
    magnitudes = galaxy_magnitudes(rng, area, faintest, density)
    if stars is None:
        star = star_magnitudes(rng, area, faintest)
    else:
        wanted = rng.poisson(stars / max(1 - stars, 1e-3) * len(magnitudes))
        pool = star_magnitudes(rng, max(area, 100.0), faintest)
        star = rng.choice(pool, wanted)
    found: list[SkySource] = []
    for mag in magnitudes:
        at, host = _place(rng, side_arcsec, found, clustering)
        found.append(_galaxy(rng, mag, half_light_arcsec(rng, mag), at, host))
    for _ in range(n_large):
        size = np.exp(rng.uniform(*np.log(LARGE_ARCSEC)))
        # the magnitude of a galaxy as large, by the relation of counts.py, half a magnitude about
        mag = 18.5 - 5 * np.log10(size / 1.8) + rng.normal(0, 0.5)
        at = rng.uniform(-side_arcsec / 2, side_arcsec / 2, 2)
        found.append(_galaxy(rng, mag, size, at, -1))
    for mag in star:
        at, host = _place(rng, side_arcsec, found, clustering)
        parts = star_parts(rng.normal(*STAR_SPECTRUM))
        found.append(SkySource(parts, at, float(mag), "star", host))
    return found


def _place(rng, side, found, clustering):
    """A position (2,) [arcsec] and its host: another source, by chance, or -1."""
    if found and rng.uniform() < clustering:
        host = int(rng.integers(len(found)))
        return found[host].position + rng.normal(0, CLUSTER_ARCSEC, 2), host
    return rng.uniform(-side / 2, side / 2, 2), -1


def _galaxy(rng, mag, size, at, host):
    """A galaxy of a magnitude and half-light radius [arcsec]."""
    mag = float(mag)
    parts, n = galaxy_parts(rng, mag, size, DISK_SPECTRUM, RED_SPECTRUM)
    return SkySource(parts, at, mag, "galaxy", host, size, n)


def bright_sources(rng, side_arcsec):
    """SkySources of the bright field: six bright galaxies, small ones, five stars."""
    scale, half = EUCLID_VIS.pixel_scale_arcsec, side_arcsec / 2
    inner = half * (1 - 2 * BRIGHT_BORDER)
    found = []
    for i in range(N_BRIGHT):
        size = scale * np.exp(rng.uniform(*np.log(BRIGHT_PX)))
        n = BRIGHT_N[0] if i % 2 == 0 else rng.uniform(*BRIGHT_N)
        spectrum = rng.normal(*(DISK_SPECTRUM if n < DISK_LIKE else RED_SPECTRUM))
        if n < DISK_LIKE:
            parts = disk_parts(rng, size, spectrum, n=n, n_knots=N_KNOTS, knots=KNOT_FRACTION)
        else:
            parts = elliptical_parts(rng, size, n, spectrum)
        at, mag = rng.uniform(-inner, inner, 2), float(rng.uniform(*BRIGHT_MAG))
        found.append(SkySource(parts, at, mag, "galaxy", -1, size, n))
    for _ in range(round(N_SMALL_1024 * (side_arcsec / scale / 1024) ** 2)):
        mag = float(rng.uniform(*SMALL_MAG))
        parts = (smooth_part(parametric_galaxy(rng), 1.0, rng.normal(*DISK_SPECTRUM)),)
        at = rng.uniform(-half, half, 2)
        found.append(SkySource(parts, at, mag, "galaxy", -1, HALF_LIGHT_ARCSEC, 1.0))
    for i in range(N_STARS):
        mag = SATURATED_MAG if i == 0 else float(rng.uniform(*STAR_MAG))
        parts = star_parts(rng.normal(*STAR_SPECTRUM))
        found.append(SkySource(parts, rng.uniform(-inner, inner, 2), mag, "star"))
    return found


def painted_field(
    sources, grids, surveys, rngs, spoilers, *, psf_variation, bad_columns, center_deg
) -> SimulatedField:
    """The SimulatedField of SkySources on flat grids, one of each survey."""
    mosaics, powers = zip(
        *(
            painted(
                survey,
                grid,
                sources,
                spoilers,
                rng,
                center_deg,
                second=i > 0,
                variation=psf_variation,
                axis=1 - i,
                bad_columns=bad_columns,
            )
            for i, (survey, grid, rng) in enumerate(zip(surveys, grids, rngs, strict=True))
        ),
        strict=True,
    )
    bands = [band for survey in surveys for band in survey.bands]
    truth = _truth(sources, bands, grids[0], mosaics[0].grid)
    truth["snr"] = np.sqrt(sum(powers))
    return SimulatedField(mosaics, truth, _clumps(sources, bands, grids[0], mosaics[0].grid))


def spoilers_of(sky, spoilers):
    """The Spoilers of a kind of sky: those given, else the usual ones of it."""
    if spoilers is not None:
        return spoilers
    return Spoilers() if sky == "real" else Spoilers.none(saturation=True)


def _placed(positions, grid, placed):
    """Columns ra, dec [deg], y, x [px] of positions (n, 2) [arcsec]."""
    pixels = np.linalg.solve(grid.jacobian, (positions - grid.origin).T)
    ra, dec = placed.sky(*pixels)
    return {"ra": ra, "dec": dec, "y": pixels[0], "x": pixels[1]}


def _truth(sources, bands, grid, placed):
    positions = np.array([s.position for s in sources]).reshape(-1, 2)
    truth = _placed(positions, grid, placed)
    truth["host"] = np.array([s.host for s in sources], int)
    truth["kind"] = np.array([s.kind for s in sources], "U6")
    truth["size"] = np.array([s.size_arcsec for s in sources])
    truth["n"] = np.array([s.n for s in sources])
    total = np.array([band_fluxes(s, bands).sum(axis=0) for s in sources]).reshape(-1, len(bands))
    flux = total * 10 ** (-0.4 * (np.array([s.mag_i for s in sources])[:, None] - 23.9))
    for band, column in zip(bands, flux.T, strict=True):
        truth[f"mag_{band}"], truth[f"flux_{band}"] = 23.9 - 2.5 * np.log10(column), column
    return truth


def _clumps(sources, bands, grid, placed):
    group, positions, fluxes = [], [np.zeros((0, 2))], [np.zeros((0, len(bands)))]
    for number, source in enumerate(sources):
        unit = 10 ** (-0.4 * (source.mag_i - 23.9))
        for part, flux in zip(source.parts, band_fluxes(source, bands) * unit, strict=True):
            group += [number] * len(part.clump_fractions)
            positions.append(source.position + part.clumps_arcsec)
            fluxes.append(part.clump_fractions[:, None] * flux)
    clumps = {"group": np.array(group, int)} | _placed(np.concatenate(positions), grid, placed)
    columns = np.concatenate(fluxes).T
    return clumps | {f"flux_{b}": column for b, column in zip(bands, columns, strict=True)}
