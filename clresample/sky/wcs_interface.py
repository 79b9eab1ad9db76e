"""A celestial WCS of any package that has astropy's common interface, as grids use it.

The interface is that of astropy's proposal for enhancement 14 (`astropy.wcs.wcsapi`): gwcs of JWST
and Roman, AST's of Rubin, slices of cubes. Here a WCS has two pixel axes, x and y, and a longitude
and a latitude, in any order and unit.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
from astropy import units as u
from astropy.coordinates import ICRS, BaseCoordinateFrame, SkyCoord
from astropy.wcs import WCS, Sip
from astropy.wcs.utils import celestial_frame_to_wcs
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS

# [px] FITS approximations have the lowest order with a smaller error: a hundredth of the errors of
# the brightest stars' centroids.
FITS_PX = 1e-4
MAX_ORDER = 5  # of the SIP polynomials: higher ones follow rounding, not optics
N_POINTS = 25  # along each axis: four times as many as the coefficients of the highest order
INVERSE_PX = 1e-8  # [px] inverses with smaller errors need no Newton step
STEP_PX = 0.5  # [px] of the finite differences of a Newton step
STEPS_PX = np.eye(2) * STEP_PX


@dataclass(frozen=True, eq=False)
class Ape14Wcs:
    """A WCS behind the common interface, for an array that starts at pixel (y0, x0) of its own.

    low: BaseLowLevelWCS of two pixel and two world axes; frame: astropy's celestial frame
    lng, lat: indices of the world axes longitude and latitude
    to_deg (2,): factors from the world axes' units to degrees
    """

    low: BaseLowLevelWCS
    frame: BaseCoordinateFrame
    lng: int
    lat: int
    to_deg: tuple[float, float]
    y0: float = 0.0
    x0: float = 0.0

    @classmethod
    def of(cls, wcs) -> Ape14Wcs:
        """The Ape14Wcs of a WCS. Raises ValueError for one that is not celestial alone."""
        low = wcs.low_level_wcs if isinstance(wcs, BaseHighLevelWCS) else wcs
        if (low.pixel_n_dim, low.world_n_dim) != (2, 2):
            raise ValueError(
                f"wcs has {low.pixel_n_dim} pixel and {low.world_n_dim} world axes, must have two "
                "celestial ones: cut a plane out (astropy.wcs.wcsapi.SlicedLowLevelWCS)"
            )
        frame, (lng, lat) = _sky_axes(low)
        one, other = (float(u.Unit(unit).to(u.deg)) for unit in low.world_axis_units)
        return cls(_unbounded(low), frame, lng, lat, (one, other))

    @property
    def names(self) -> tuple[str, str]:
        """Names of longitude and latitude as FITS has them: ra and dec, glon and glat."""
        wcs = celestial_frame_to_wcs(self.frame).wcs
        return wcs.lngtyp.lower(), wcs.lattyp.lower()

    def world_at(self, n, m):
        """Longitude and latitude (2, ...) [deg] of the pixels n, m (...); NaN where none is."""
        m, n = np.asarray(m, np.float64) + self.x0, np.asarray(n, np.float64) + self.y0
        world = self.low.pixel_to_world_values(m, n)
        world = [np.asarray(w, np.float64) * k for w, k in zip(world, self.to_deg, strict=True)]
        return np.stack([world[self.lng] % 360.0, world[self.lat]])

    def pixels_at(self, lon, lat):
        """Pixels (L, 2), (y, x), at the points lon, lat (L,) [deg]; NaN where there is none."""
        world = [np.zeros(0)] * 2
        world[self.lng] = np.asarray(lon, np.float64) / self.to_deg[self.lng]
        world[self.lat] = np.asarray(lat, np.float64) / self.to_deg[self.lat]
        x, y = self.low.world_to_pixel_values(*world)
        found = np.stack([np.asarray(y) - self.y0, np.asarray(x) - self.x0], axis=-1)
        return self._refined(found, np.stack([lon, lat]))

    def _refined(self, pixels, world):
        """Pixels (L, 2) after a Newton step: some inverses stop at 1e-4 px."""
        here = self.world_at(*pixels.T)
        off = _offsets(here, world)
        sides = [_offsets(here, self.world_at(*(pixels + step).T)) for step in STEPS_PX]
        jacobian = np.stack(sides, axis=-1) / STEP_PX  # (2, L, 2)
        good = np.isfinite(jacobian).all(axis=(0, 2)) & np.isfinite(off).all(axis=0)
        matrix, right = np.moveaxis(jacobian, 0, 1)[good], off.T[good]
        px = abs(matrix).max(axis=(1, 2))  # [deg]
        if (abs(right).max(axis=1) <= INVERSE_PX * px).all():
            return pixels
        pixels[good] += np.linalg.solve(matrix, right[..., None])[..., 0]
        return pixels

    def shifted(self, y0, x0) -> Ape14Wcs:
        """The same WCS for an array that starts at (y0, x0)."""
        return replace(self, y0=self.y0 + y0, x0=self.x0 + x0)

    def to_fits(self, shape) -> WCS:
        """A FITS WCS of an image (Ny, Nx): gnomonic with SIP polynomials fitted to this one.

        It has the lowest order, up to 5, that departs from it by less than 1e-4 px; else order 5.
        """
        y, x = (np.linspace(-0.5, n - 0.5, N_POINTS) for n in shape)
        points = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
        middle = (np.array(shape) - 1) / 2
        world = self.world_at(*points.T)
        good = np.isfinite(world).all(axis=0)
        points, world = points[good], world[:, good]
        wcs = None
        for order in range(1, MAX_ORDER + 1):
            wcs = _fitted(self.frame, self.world_at(*middle), middle, points, world, order)
            step = _offsets(world, np.array(wcs.all_pix2world(points[:, 1], points[:, 0], 0)))
            scale = np.sqrt(abs(np.linalg.det(wcs.pixel_scale_matrix)))
            if np.abs(step).max() <= FITS_PX * scale:
                break
        return wcs


def _offsets(world, other):
    """From points (2, ...) [deg] to others near by, (2, ...) [deg]: along the parallel, and up."""
    step = other - world
    step[0] = ((step[0] + 180) % 360 - 180) * np.cos(np.radians(world[1]))
    return step


def _sky_axes(low):
    """The celestial frame, and the indices of its longitude and latitude axes."""
    for key, entry in low.world_axis_object_classes.items():
        if not (isinstance(entry[0], type) and issubclass(entry[0], SkyCoord)):
            continue
        frame = entry[2].get("frame", ICRS())
        axes = [part[1] for part in low.world_axis_object_components if part[0] == key]
        if len(axes) == 2:
            frame = frame() if isinstance(frame, type) else SkyCoord(0, 0, unit="deg", frame=frame)
            frame = frame.frame if isinstance(frame, SkyCoord) else frame
            order = (0, 1) if axes[0] in (0, "lon", "ra", "l") else (1, 0)
            return frame.replicate_without_data(), order
    kinds = ", ".join(str(kind) for kind in low.world_axis_physical_types)
    raise ValueError(f"wcs has no celestial axes (its world axes: {kinds})")


def _unbounded(low):
    """The WCS without a bounding box, like a FITS WCS, for cutouts that reach beyond it."""
    if getattr(low, "bounding_box", None) is None:
        return low
    low = copy.deepcopy(low)
    low.bounding_box = None
    return low


def _fitted(frame, center, middle, points, world, order):
    """A gnomonic WCS about a centre (2,) [deg] at the pixel `middle`, with SIP of an order."""
    wcs = celestial_frame_to_wcs(frame, projection="TAN")
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = center, (0, 0), (1, 1)
    plane = wcs.wcs_world2pix(world.T, 1)  # [deg] on the tangent plane
    size = np.array(middle) + 1.0
    g, f = ((points - middle) / size).T  # y and x, -1 to 1: powers of one size
    powers = [(p, q) for p in range(order + 1) for q in range(order + 1 - p) if p + q]
    terms = np.stack([f**p * g**q for p, q in powers], axis=1)
    found = dict(zip(powers, np.linalg.lstsq(terms, plane, rcond=None)[0], strict=True))
    cd = np.stack([found[1, 0] / size[1], found[0, 1] / size[0]], axis=1)
    wcs.wcs.cd, wcs.wcs.crpix = cd, np.array(middle)[::-1] + 1.0
    if order > 1:
        a, b = np.zeros((2, order + 1, order + 1))
        for (p, q), value in found.items():
            if p + q > 1:
                a[p, q], b[p, q] = np.linalg.solve(cd, value) / (size[1] ** p * size[0] ** q)
        wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
        wcs.wcs.ctype = [f"{axis}-SIP" for axis in wcs.wcs.ctype]
    wcs.wcs.set()
    return wcs
