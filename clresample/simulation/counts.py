"""Numbers, brightnesses and sizes of galaxies and stars on the sky, after published relations.

Galaxies: N(<i) = 46 x 10^(0.31 (i - 25)) per square arcminute, LSST Science Collaboration 2009
(arXiv:0912.0201, section 3.7.2), for i > 20; brighter ones fall as 10^(0.6 i), as of equal galaxies
at any distance in space without evolution, measured by Yasuda et al. 2001 (AJ 122, 1104).

Sizes: ln(r_d / arcsec) = -1.145 - 0.269 (i - 23), r_d being the scale length of disks, Miller et
al. 2013 (MNRAS 429, 2858, appendix B1) after Simard et al. 2002, for i > 18.5; brighter ones grow
as 10^(-0.2 i), as of equal galaxies at any distance. Scatter of ln r: Shen et al. 2003 (MNRAS 343,
978), 0.3 for bright galaxies to 0.5 for faint ones.

Ellipticals: Sersic indices that grow with luminosity, to n = 6 and above, Caon, Capaccioli &
D'Onofrio 1993 (MNRAS 265, 1013); a third of bright galaxies, a tenth of faint ones (Miller et al.).

Stars at high latitude: 0.6 per square arcminute to 20, 10^(0.2 m) brighter and 10^(0.1 m) fainter,
about those of Bahcall & Soneira 1980 (ApJS 44, 73) at the galactic pole.
"""

from __future__ import annotations

import numpy as np

BRIGHTEST_GALAXY, BRIGHTEST_STAR = 13.0, 12.0  # [mag] i of the brightest that are drawn
MAX_SIZE_ARCSEC = 20.0  # [arcsec] half-light radius of the largest galaxy that is drawn
MIN_SIZE_ARCSEC = 0.05  # [arcsec] of the smallest: compact galaxies of HST's deepest fields
DISK_HALF_LIGHT = 1.678  # [scale lengths] half-light radius of an exponential disk
GALAXY_BREAK, GALAXY_SLOPES = 20.0, (0.6, 0.31)  # [mag], [dex/mag] brighter, fainter
STAR_BREAK, STAR_SLOPES = 20.0, (0.2, 0.1)
GALAXIES_TO_BREAK = 46 * 10 ** (0.31 * (GALAXY_BREAK - 25))  # [arcmin^-2]
STARS_TO_BREAK = 0.6  # [arcmin^-2]
SIZE_BREAK = 18.5  # [mag] i, above which the relation of sizes was measured


def cumulative_counts(magnitude, at_break, break_mag, slopes):
    """Sources per square arcminute brighter than magnitude [mag]."""
    bright, faint = slopes
    slope = np.where(magnitude < break_mag, bright, faint)
    return at_break * 10 ** (slope * (np.asarray(magnitude) - break_mag))


def draw_magnitudes(rng, area_arcmin2, faintest, at_break, break_mag, slopes, brightest):
    """Magnitudes (n,) [mag] of a Poisson number of sources, from brightest to faintest."""
    knots = np.linspace(brightest, faintest, 512)
    total = cumulative_counts(knots, at_break, break_mag, slopes)
    n = rng.poisson(area_arcmin2 * (total[-1] - total[0]))
    return np.interp(rng.uniform(total[0], total[-1], n), total, knots)


def galaxy_magnitudes(rng, area_arcmin2, faintest, density=None):
    """i magnitudes (n,) of galaxies; density [arcmin^-2]: to `faintest`, None = as published."""
    published = cumulative_counts(faintest, GALAXIES_TO_BREAK, GALAXY_BREAK, GALAXY_SLOPES)
    at_break = GALAXIES_TO_BREAK * (1.0 if density is None else density / published)
    return draw_magnitudes(
        rng, area_arcmin2, faintest, at_break, GALAXY_BREAK, GALAXY_SLOPES, BRIGHTEST_GALAXY
    )


def star_magnitudes(rng, area_arcmin2, faintest, scale=1.0):
    """i magnitudes (n,) of stars; scale: of their number as published."""
    at_break = STARS_TO_BREAK * scale
    return draw_magnitudes(
        rng, area_arcmin2, faintest, at_break, STAR_BREAK, STAR_SLOPES, BRIGHTEST_STAR
    )


def half_light_arcsec(rng, magnitude) -> float:
    """Half-light radius [arcsec] of a galaxy of an i magnitude."""
    faint = max(magnitude, SIZE_BREAK)
    log = -1.145 - 0.269 * (faint - 23) + 0.2 * np.log(10) * (faint - magnitude)
    scatter = np.interp(magnitude, (18.0, 23.0), (0.3, 0.5))
    size = DISK_HALF_LIGHT * np.exp(log + scatter * rng.standard_normal())
    return float(np.clip(size, MIN_SIZE_ARCSEC, MAX_SIZE_ARCSEC))


def is_elliptical(rng, magnitude) -> bool:
    """Returns True if a galaxy of an i magnitude has no disk."""
    return bool(rng.uniform() < np.interp(magnitude, (18.0, 23.0), (1 / 3, 0.1)))


def sersic_index(rng, magnitude) -> float:
    """Sersic index of an elliptical of an i magnitude, 2 to 6."""
    mean = np.interp(magnitude, (16.0, 24.0), (5.0, 2.5))
    return float(np.clip(mean + rng.normal(0, 1.0), 2.0, 6.0))
