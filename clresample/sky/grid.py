"""Pixel grids on the sky: placed by any celestial WCS or laid flat, with their cutouts."""

from __future__ import annotations

import math
import weakref
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS

from ..drawing.display import GridDisplay
from .mapping import Mapping, map_affine, map_positions
from .validation.checks import (
    as_float_array,
    check_image_shape,
    check_instance,
    check_number,
    check_pixel_scale,
    described,
)
from .wcs import (
    celestial_frame,
    celestial_wcs,
    convert,
    cutout_wcs,
    pixel_scale,
    pixel_to_world,
    refined_wcs,
    tangent_wcs,
    world_to_pixel,
)
from .wcs_interface import Ape14Wcs

LAST: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # see Grid.map_to


class Grid(GridDisplay, ABC):
    """Pixels of one image and their positions on the sky.

    shape (Ny, Nx) [px]
    is_flat: True if the sky is a plane with positions (y, x) [arcsec]; else positions are longitude
        and latitude [deg] of a celestial WCS
    sky_description: the same in words, for messages

    Make one with `Grid.from_wcs`, `Grid.flat` or `Grid.from_jacobian`. Positions in pixels are
    (n, m) = (row, column) or (y, x), whole at the centre of a pixel.
    """

    shape: tuple[int, int]
    is_flat: bool
    sky_description: str

    @staticmethod
    def from_wcs(wcs, shape) -> Grid:
        """Grid of an image with a celestial WCS: CD, PC, CROTA, SIP, TPV, cubes, either parity.

        wcs: astropy WCS, of which only the celestial axes are used; or any object of two axes
            with astropy's common interface (APE 14), such as a gwcs of JWST or Roman
        shape (..., Ny, Nx) [px]: the last two numbers are used

        Raises ValueError without a celestial part, or where it cannot be evaluated.
        """
        shape = check_image_shape(shape[-2:])
        return WcsGrid(shape, celestial_wcs(wcs, shape))

    @staticmethod
    def flat(shape, scale_arcsec, *, angle_deg=0, flip=False, center_arcsec=(0, 0)) -> Grid:
        """Grid on a flat sky: J = R(angle) diag(scale_y, +-scale_x).

        shape (Ny, Nx) [px]
        scale_arcsec [arcsec/px]: one number or (y, x)
        angle_deg: turns the pixel axes counter-clockwise, x to the right and y up
        flip: columns run the other way (opposite parity)
        center_arcsec (2,): (y, x) of the stamp's centre, pixel ((Ny-1)/2, (Nx-1)/2)

        Raises ValueError for a scale that is not positive.
        """
        shape = check_image_shape(shape)
        scale = check_pixel_scale("scale_arcsec", scale_arcsec)
        if not (np.isfinite(scale) & (scale > 0)).all():
            raise ValueError(f"scale_arcsec must be positive, not {scale_arcsec}")
        cos, sin = _cos_sin(check_number("angle_deg", angle_deg))
        jacobian = np.array([[cos, sin], [-sin, cos]]) * scale * (1, -1 if flip else 1)
        center = check_pixel_scale("center_arcsec", center_arcsec)
        return FlatGrid(shape, jacobian, center - jacobian @ ((np.array(shape) - 1) / 2))

    @staticmethod
    def from_jacobian(shape, jacobian, origin) -> Grid:
        """Grid on a flat sky with any Jacobian: (y, x) = J (n, m) + origin.

        shape (Ny, Nx) [px]
        jacobian (2, 2) [arcsec/px]: rows (y, x) of the sky, columns (n, m)
        origin (2,) [arcsec]: (y, x) of pixel (0, 0)

        Raises ValueError for other shapes, and numbers that are not finite.
        """
        jacobian, origin = as_float_array("jacobian", jacobian), as_float_array("origin", origin)
        for name, array, expected in (("jacobian", jacobian, (2, 2)), ("origin", origin, (2,))):
            if array.shape != expected or not np.isfinite(array).all():
                raise ValueError(f"{name} is {array.tolist()}, must be {expected} finite numbers")
        return FlatGrid(check_image_shape(shape), jacobian.copy(), origin.copy())

    @property
    @abstractmethod
    def pixel_scale_arcsec(self) -> float:
        """Square root of the central pixel's area [arcsec]."""

    @abstractmethod
    def sky(self, n, m) -> np.ndarray:
        """Sky positions of pixels: (y, x) [arcsec] if flat, else (longitude, latitude) [deg].

        n, m: rows and columns, any shapes that broadcast
        returns (2, ...); NaN outside the projection
        """

    @abstractmethod
    def pixel(self, a, b=None) -> np.ndarray:
        """Pixel positions of points of the sky, the inverse of `sky`.

        a, b: y and x [arcsec] if flat, else longitude and latitude [deg] in the WCS's own frame
            (right ascension and declination if that is equatorial); any shapes that broadcast. Or,
            unless flat, a SkyCoord alone, of any frame
        returns (..., 2) [px]: (y, x); NaN outside the projection

        Raises ValueError for a SkyCoord on a flat grid.
        """

    @abstractmethod
    def positions_in(self, other: Grid, n, m) -> np.ndarray:
        """Pixels (n, m) of this grid in those of another one of its kind, exactly.

        n, m: rows and columns, any shapes that broadcast
        returns (..., 2) [px of `other`]: (y, x); NaN outside its projection
        """

    @abstractmethod
    def cutout(self, y0, x0, shape) -> Grid:
        """Grid of the `shape` (Ny, Nx) pixels from (y0, x0) on; they may lie outside this one."""

    @abstractmethod
    def refined(self, factor) -> Grid:
        """Grid of the same sky on pixels with sides 1 / factor as long, factor a whole number.

        Distortions are left out, except those of the projection: the sky is off by as much.
        """

    @abstractmethod
    def to_wcs(self, *, ra_deg=0.0, dec_deg=0.0) -> WCS:
        """The WCS; for a flat grid a gnomonic one (ICRS) that touches the sky at (y, x) = (0, 0).

        x increases to the west (north is up, east is left), so that two flat grids placed at the
        same point keep their mapping exactly.

        ra_deg, dec_deg [deg]: position of (0, 0); ignored by a grid that has a WCS
        """

    @abstractmethod
    def _map_to(self, grid_in, tolerance_px):
        """`map_to` of grids known to be of one kind."""

    def map_to(self, grid_in: Grid, tolerance_px=1e-4) -> Mapping:
        """Mapping of this grid's pixels into those of `grid_in`: X = A p + t, or one by one.

        Both WCS are evaluated and their celestial frames (ICRS, FK5, galactic, ...) converted. A
        and t are fitted where `grid_in` covers this grid; the residuals of the fit decide the
        geometry. The last mapping without positions is cached, because a fit and its measurements
        reuse it.

        grid_in: the model's grid; WCS or flat as this one is
        tolerance_px [model px]: largest departure that is ignored

        Raises ValueError if only one grid is flat, if no pixel lies in `grid_in`'s projection, and
        for a singular Jacobian.
        """
        grid_in = as_grid("grid_in", grid_in)
        self.check_like(grid_in, "grid_in")
        tolerance = check_number(
            "tolerance_px", tolerance_px, "0 or more", lambda x: 0 <= x < math.inf
        )
        other, known_tolerance, known = LAST.get(self, (lambda: None, None, None))
        if other() is grid_in and known_tolerance == tolerance:
            return known
        mapping = self._map_to(grid_in, tolerance)
        if mapping.positions is None:
            for shared in (mapping.matrix, mapping.offset):
                shared.flags.writeable = False
            LAST[self] = weakref.ref(grid_in), tolerance, mapping
        return mapping

    def check_like(self, other: Grid, name):
        """Raises ValueError, naming the other grid `name`, if only one of the two is flat."""
        if self.is_flat != other.is_flat:
            raise ValueError(
                f"{name} is {other.sky_description} and this grid {self.sky_description}: "
                "give both a WCS (Grid.to_wcs)"
            )


@dataclass(frozen=True, eq=False, repr=False)
class FlatGrid(Grid):
    """Pixels on a flat sky: (y, x) = J (n, m) + origin.

    shape (Ny, Nx) [px]
    jacobian (2, 2) [arcsec/px]: J, rows (y, x) of the flat sky, columns (n, m) = (row, column)
    origin (2,) [arcsec]: (y, x) of pixel (0, 0) on the flat sky
    """

    shape: tuple[int, int]
    jacobian: np.ndarray
    origin: np.ndarray
    is_flat, sky_description = True, "flat"

    @property
    def pixel_scale_arcsec(self):
        """sqrt |det J| [arcsec]."""
        return math.sqrt(abs(np.linalg.det(self.jacobian)))

    def sky(self, n, m):
        """(y, x) [arcsec] at pixels (n, m): J (n, m) + origin, (2, ...)."""
        n, m = _float_arrays(n, m)
        origin = self.origin.reshape((2,) + (1,) * n.ndim)
        return np.tensordot(self.jacobian, np.stack([n, m]), 1) + origin

    def pixel(self, a, b=None):
        """Pixels (..., 2) at (y, x) = (a, b) [arcsec]: J^-1 ((a, b) - origin)."""
        if b is None:
            raise ValueError(
                f"position is {described(a)}, but this grid is flat: give (y, x) [arcsec], or the "
                "grid a WCS (Grid.to_wcs)"
            )
        inverse = np.linalg.inv(self.jacobian)
        return (np.stack(_float_arrays(a, b), axis=-1) - self.origin) @ inverse.T

    def positions_in(self, other, n, m):
        """A (n, m) + t (..., 2), with A and t from the two Jacobians and origins."""
        matrix, offset = self._affine_to(other)
        return np.stack(np.broadcast_arrays(n, m), axis=-1) @ matrix.T + offset

    def cutout(self, y0, x0, shape):
        """The same Jacobian, the origin at pixel (y0, x0)."""
        return FlatGrid(
            check_image_shape(shape), self.jacobian, self.origin + self.jacobian @ (y0, x0)
        )

    def refined(self, factor):
        """The Jacobian over the factor, with the outer edges of these pixels."""
        origin = self.origin + self.jacobian @ np.full(2, (1 / factor - 1) / 2)
        return FlatGrid(_refined_shape(self.shape, factor), self.jacobian / factor, origin)

    def to_wcs(self, *, ra_deg=0.0, dec_deg=0.0):
        """A gnomonic WCS (ICRS) that touches the flat sky at (y, x) = (0, 0)."""
        return tangent_wcs(self.jacobian, self.origin, ra_deg, dec_deg)

    def _map_to(self, grid_in, tolerance_px):
        """Aligned or affine, exactly."""
        matrix, offset = self._affine_to(grid_in)
        return map_affine(matrix, offset, grid_in.shape, self.shape, tolerance_px)

    def _affine_to(self, other):
        """A (2, 2) and t (2,) from these pixels to those of another flat grid."""
        matrix = np.linalg.solve(other.jacobian, self.jacobian)
        return matrix, np.linalg.solve(other.jacobian, self.origin - other.origin)


@dataclass(frozen=True, eq=False, repr=False)
class WcsGrid(Grid):
    """Pixels placed by a celestial WCS.

    shape (Ny, Nx) [px]
    wcs: astropy WCS of the two celestial axes, or Ape14Wcs
    """

    shape: tuple[int, int]
    wcs: WCS | Ape14Wcs
    is_flat, sky_description = False, "placed by a WCS"

    @property
    def pixel_scale_arcsec(self):
        """Square root of the central pixel's area [arcsec], from the WCS evaluated around it."""
        return pixel_scale(self.wcs, *(np.array(self.shape) - 1) / 2)

    def sky(self, n, m):
        """Longitude and latitude (2, ...) [deg] at pixels (n, m)."""
        return pixel_to_world(self.wcs, *_float_arrays(n, m))

    def pixel(self, a, b=None):
        """Pixels (..., 2) at longitudes a and latitudes b [deg], or at a SkyCoord a."""
        if b is None:
            sky = a.transform_to(celestial_frame(self.wcs)).spherical
            a, b = sky.lon.deg, sky.lat.deg
        a, b = _float_arrays(a, b)
        return world_to_pixel(self.wcs, a.ravel(), b.ravel()).reshape(a.shape + (2,))

    def positions_in(self, other, n, m):
        """Both WCS evaluated point by point (..., 2), their celestial frames converted."""
        world = pixel_to_world(self.wcs, *np.broadcast_arrays(n, m))
        good = np.isfinite(world).all(axis=0)
        result = np.full(good.shape + (2,), np.nan)
        if good.any():
            lon, lat = convert(self.wcs, other.wcs, *world[:, good])
            result[good] = world_to_pixel(other.wcs, lon, lat)
        return result

    def cutout(self, y0, x0, shape):
        """The same WCS with its reference pixel, and those of its distortions, moved."""
        return WcsGrid(check_image_shape(shape), cutout_wcs(self.wcs, y0, x0))

    def refined(self, factor):
        """The WCS with smaller pixels, without SIP and tables of distortion."""
        return WcsGrid(_refined_shape(self.shape, factor), refined_wcs(self.to_wcs(), factor))

    def to_wcs(self, *, ra_deg=0.0, dec_deg=0.0):
        """A copy of the WCS, of an Ape14Wcs its FITS approximation."""
        if isinstance(self.wcs, Ape14Wcs):
            return self.wcs.to_fits(self.shape)
        return self.wcs.deepcopy()

    def _map_to(self, grid_in, tolerance_px):
        """The simplest geometry that agrees with both WCS within tolerance_px."""
        return map_positions(
            lambda n, m: self.positions_in(grid_in, n, m),
            lambda n, m: grid_in.positions_in(self, n, m),
            grid_in.shape,
            self.shape,
            tolerance_px,
        )


# A Grid, or a WCS of astropy or of another package.
GridLike = Grid | BaseLowLevelWCS | BaseHighLevelWCS


def as_grid(name, grid, shape=None) -> Grid:
    """The Grid, made from a WCS if one is passed: astropy's, gwcs, or any other of APE 14.

    shape (..., Ny, Nx) [px]: of the image; None = that of the WCS (array_shape)

    Raises ValueError for anything else, and for a WCS without a shape.
    """
    if not isinstance(grid, BaseLowLevelWCS | BaseHighLevelWCS):
        return check_instance(name, grid, Grid)
    if shape is None:
        low = grid.low_level_wcs if isinstance(grid, BaseHighLevelWCS) else grid
        shape = low.array_shape
    if shape is None or len(shape) < 2:
        raise ValueError(f"{name} is a WCS without a shape: give Grid.from_wcs(wcs, shape)")
    return Grid.from_wcs(grid, shape)


def _refined_shape(shape, factor):
    """A shape (2,) on pixels of 1 / factor the length."""
    return tuple(factor * n for n in shape)


def _cos_sin(angle_deg):
    """Rotation matrix, exact at quarter turns, so that these stay aligned."""
    quarter, rest = divmod(angle_deg, 90)
    if rest == 0:
        return ((1, 0), (0, 1), (-1, 0), (0, -1))[int(quarter) % 4]
    return math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))


def _float_arrays(a, b):
    """Both as float64 arrays of their common shape."""
    return np.broadcast_arrays(np.asarray(a, np.float64), np.asarray(b, np.float64))
