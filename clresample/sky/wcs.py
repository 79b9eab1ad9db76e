"""Functions of a WCS, astropy's or an Ape14Wcs, for grids.

Longitudes come before latitudes, whatever the order of a header's axes. The inverse returns NaN
where astropy's raises.
"""

from __future__ import annotations

import math

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS, DistortionLookupTable, NoConvergence, Sip
from astropy.wcs.utils import wcs_to_celestial_frame
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS

from .validation.checks import check_instance
from .wcs_interface import Ape14Wcs

# [px] Tolerance of the iterated inverse of SIP and look-up tables, far below NOISE_PX.
INVERSE_PX = 1e-8
# [px] Largest error of a pixel mapped to the sky and back: angles of sixteen digits have it for
# pixels of 0.1 milliarcseconds.
BACK_PX = 1e-4
ARCSEC = math.radians(1 / 3600)  # [rad]


def celestial_wcs(wcs, shape):
    """A copy of a WCS with its celestial axes only, an Ape14Wcs unless it is astropy's own.

    wcs: as `Grid.from_wcs` takes it; shape (Ny, Nx) [px]: of the image

    Raises ValueError without celestial axes, or where it cannot be evaluated.
    """
    if not isinstance(wcs, WCS):
        wcs = Ape14Wcs.of(check_instance("wcs", wcs, (WCS, BaseLowLevelWCS, BaseHighLevelWCS)))
    elif not wcs.has_celestial:
        axes = ", ".join(axis or "?" for axis in wcs.wcs.ctype)
        raise ValueError(f"wcs has no celestial axes (CTYPE: {axes})")
    try:
        if isinstance(wcs, WCS):
            wcs = wcs.celestial if wcs.naxis > 2 else wcs.deepcopy()
        celestial_frame(wcs)
        problem = pixel_problem(wcs, shape) or _lost_digits(wcs, shape)
    except Exception as error:  # wcslib raises a dozen kinds, RuntimeError among them
        raise ValueError(f"wcs cannot be used: {' '.join(str(error).split())}") from error
    if problem:
        raise ValueError(f"wcs cannot be used: its central pixel {problem}")
    return wcs


def pixel_to_world(wcs, n, m):
    """Longitude and latitude (2, ...) [deg] of the pixels n, m (...); NaN where there is none."""
    if isinstance(wcs, Ape14Wcs):
        return wcs.world_at(n, m)
    world = np.array(wcs.all_pix2world(np.ravel(m), np.ravel(n), 0))
    return world[[wcs.wcs.lng, wcs.wcs.lat]].reshape((2,) + np.shape(n))


# Largest ratio of a pixel's length to its width. Slit spectrographs have 10; larger ratios are
# mistakes in headers.
MAX_ELONGATED = 100.0


def pixel_scale(wcs, n, m):
    """Root of the area [arcsec] of the pixel at (n, m), from the WCS evaluated around it."""
    y, x = _pixel_sides(wcs, n, m)
    return math.sqrt(np.linalg.norm(np.cross(y, x))) / ARCSEC


def pixel_problem(wcs, shape):
    """Fault of the pixel in the middle of an image (Ny, Nx); None where there is none."""
    y, x = _pixel_sides(wcs, *(np.array(shape) - 1) / 2)
    scale = math.sqrt(np.linalg.norm(np.cross(y, x))) / ARCSEC
    if not scale > 0:
        return f"has the size {scale} arcsec"
    long, wide = np.linalg.svd(np.stack([y, x]), compute_uv=False)
    if not long <= MAX_ELONGATED * wide:
        return f"is {long / max(wide, np.finfo(float).tiny):.3g} times as long as wide"
    return None


def _lost_digits(wcs, shape):
    """Fault if the middle pixel of an image (Ny, Nx) is not mapped to the sky and back.

    None if it is, or if the inverse fails. WCS of other packages are not tested.
    """
    if isinstance(wcs, Ape14Wcs):
        return None
    middle = (np.array(shape) - 1) / 2
    with np.errstate(all="ignore"):
        back = world_to_pixel(wcs, *pixel_to_world(wcs, *middle[:, None]))
    off = np.abs(back - middle).max()
    if off > BACK_PX:
        return f"comes back from the sky {off:.3g} px off: an angle of the header is far too large"
    return None


def _pixel_sides(wcs, n, m):
    """Sides of a pixel as vectors (3,) on the unit sphere, along rows and along columns."""
    half = np.array([-0.5, 0.5])
    n, m = np.concatenate([n + half, [n, n]]), np.concatenate([[m, m], m + half])
    lon, lat = np.radians(pixel_to_world(wcs, n, m))
    v = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return v[:, 1] - v[:, 0], v[:, 3] - v[:, 2]


def local_axes(grid, pixel):
    """Step of one pixel on the sky: (2, 2) [arcsec/px], rows (north, east).

    Columns are (y, x). North is that of the WCS's own frame; on a flat sky it is +y, and east is
    -x, as in `Grid.to_wcs`.

    pixel (2,) [px]: (y, x), a position on the grid
    """
    if grid.is_flat:
        return grid.jacobian * [[1.0], [-1.0]]
    n, m = np.asarray(pixel)[:, None] + [[0, -0.5, 0.5, 0, 0], [0, 0, 0, -0.5, 0.5]]
    lon, lat = np.radians(grid.sky(n, m))
    v = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    steps = np.stack([v[:, 2] - v[:, 1], v[:, 4] - v[:, 3]], axis=1)
    lon, lat = lon[0], lat[0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    east = [-np.sin(lon), np.cos(lon), 0.0]
    return np.array([north, east]) @ steps / ARCSEC


def celestial_frame(wcs):
    """The celestial frame of a WCS as an astropy coordinate frame."""
    return wcs.frame if isinstance(wcs, Ape14Wcs) else wcs_to_celestial_frame(wcs)


def axis_names(wcs):
    """Names of longitude and latitude in a WCS: "ra" and "dec", "glon" and "glat", ..."""
    if isinstance(wcs, Ape14Wcs):
        return wcs.names
    return wcs.wcs.lngtyp.lower(), wcs.wcs.lattyp.lower()


def convert(wcs_from, wcs_to, lon, lat):
    """Points lon, lat (L,) [deg] of one WCS's celestial frame in that of another: (lon, lat)."""
    if _is_icrs(wcs_from) and _is_icrs(wcs_to):  # most are: astropy takes 0.1 ms to make a frame
        return lon, lat
    frames = [celestial_frame(wcs) for wcs in (wcs_from, wcs_to)]
    if frames[0].is_equivalent_frame(frames[1]):
        return lon, lat
    sky = SkyCoord(lon, lat, unit="deg", frame=frames[0]).transform_to(frames[1]).spherical
    return sky.lon.deg, sky.lat.deg


def _is_icrs(wcs):
    """Returns True if a WCS's header declares it by name."""
    return not isinstance(wcs, Ape14Wcs) and wcs.wcs.radesys == "ICRS"


def world_to_pixel(wcs, lon, lat):
    """Pixels (L, 2), (y, x), at the points lon, lat (L,) [deg]; NaN where there is none."""
    if isinstance(wcs, Ape14Wcs):
        return wcs.pixels_at(lon, lat)
    world = np.stack([lon, lat] if wcs.wcs.lng < wcs.wcs.lat else [lat, lon], axis=-1)
    try:
        pixels = wcs.all_world2pix(
            world, 0, tolerance=INVERSE_PX, maxiter=50, adaptive=True, detect_divergence=True
        )
    except NoConvergence as error:
        pixels = error.best_solution
        for lost in (error.divergent, error.slow_conv):
            if lost is not None:
                pixels[lost] = np.nan
    return pixels[:, ::-1]


def tangent_wcs(jacobian, origin, ra_deg, dec_deg):
    """A flat sky as a tangent plane: gnomonic, ICRS, (y, x) = (0, 0) at (ra, dec) [deg].

    jacobian (2, 2) [arcsec/px], origin (2,) [arcsec]: of a FlatGrid
    """
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.cunit = ["deg", "deg"]
    wcs.wcs.radesys = "ICRS"
    wcs.wcs.crval = [ra_deg, dec_deg]
    n, m = np.linalg.solve(jacobian, -origin)
    wcs.wcs.crpix = [m + 1, n + 1]
    # rows (west, north) of columns (m, n), west counted as minus right ascension
    wcs.wcs.cd = jacobian[::-1, ::-1] * [[-1], [1]] / 3600
    wcs.wcs.set()
    return wcs


def cutout_wcs(wcs, y0, x0):
    """The same WCS for an array that starts at (y0, x0)."""
    if isinstance(wcs, Ape14Wcs):
        return wcs.shifted(y0, x0)
    wcs = wcs.deepcopy()
    shift = np.array([x0, y0], dtype=np.float64)
    wcs.wcs.crpix = wcs.wcs.crpix - shift
    if wcs.sip is not None:
        sip = wcs.sip
        wcs.sip = Sip(sip.a, sip.b, sip.ap, sip.bp, sip.crpix - shift)
    for name in ("cpdis1", "cpdis2", "det2im1", "det2im2"):
        table = getattr(wcs, name)
        if table is not None:
            crval = tuple(np.array(table.crval) - shift)
            moved = DistortionLookupTable(table.data, tuple(table.crpix), crval, tuple(table.cdelt))
            setattr(wcs, name, moved)
    wcs.wcs.set()
    return wcs


def refined_wcs(wcs, factor):
    """An astropy WCS of pixels with sides 1 / factor as long, without SIP and distortion tables."""
    wcs = wcs.deepcopy()
    wcs.sip = wcs.cpdis1 = wcs.cpdis2 = wcs.det2im1 = wcs.det2im2 = None
    wcs.wcs.ctype = [name.removesuffix("-SIP") for name in wcs.wcs.ctype]
    wcs.wcs.crpix = (wcs.wcs.crpix - 0.5) * factor + 0.5
    if wcs.wcs.has_cd():
        wcs.wcs.cd = wcs.wcs.cd / factor
    else:
        wcs.wcs.cdelt = wcs.wcs.cdelt / factor
    wcs.wcs.set()
    return wcs
