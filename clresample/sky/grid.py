"""Pixel grids on the sky: from any celestial WCS or laid flat, and their boxes and cutouts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from astropy.wcs.utils import wcs_to_celestial_frame

from .mapping import map_affine, map_positions
from .wcs import pixels_at, shifted_wcs

__all__ = ["Grid"]

ARCSEC = math.radians(1 / 3600)  # [rad]


@dataclass(frozen=True, eq=False)
class Grid:
    """Pixels of one image, placed either by a celestial WCS or flat, by a Jacobian and an origin.

    shape (Ny, Nx) [px]
    wcs: astropy WCS of the two celestial axes; None for a flat grid
    jacobian (2, 2) [arcsec/px]: rows (y, x) of the flat sky, columns (n, m) = (row, column)
    origin (2,) [arcsec]: (y, x) of pixel (0, 0) on the flat sky

    Make one with `Grid.from_wcs` or `Grid.flat`.
    """

    shape: tuple
    wcs: WCS | None = None
    jacobian: np.ndarray | None = None
    origin: np.ndarray | None = None

    @classmethod
    def from_wcs(cls, wcs, shape):
        """Grid of an image with a celestial WCS: CD, PC, CROTA, SIP, TPV, cubes, either parity.

        wcs: astropy WCS; of more than two axes, the celestial ones are taken
        shape (..., Ny, Nx) [px]: the last two count

        Raises ValueError without a celestial part, or where it cannot be evaluated.
        """
        shape = _shape(shape[-2:])
        if not wcs.has_celestial:
            axes = ", ".join(axis or "?" for axis in wcs.wcs.ctype)
            raise ValueError(f"wcs has no celestial axes (CTYPE: {axes})")
        try:
            wcs = wcs.celestial if wcs.naxis > 2 else wcs.deepcopy()
            wcs_to_celestial_frame(wcs)
            grid = cls(shape, wcs)
            scale = grid.pixel_scale_arcsec
        except Exception as error:  # wcslib raises a dozen kinds, RuntimeError among them
            raise ValueError(f"wcs cannot be used: {' '.join(str(error).split())}") from error
        if not scale > 0:
            raise ValueError(f"wcs cannot be used: its central pixel has the size {scale} arcsec")
        return grid

    @classmethod
    def flat(cls, shape, scale_arcsec, *, angle_deg=0, flip=False, center_arcsec=(0, 0)):
        """Grid on a flat sky: J = R(angle) diag(scale_y, +-scale_x).

        shape (Ny, Nx) [px]
        scale_arcsec [arcsec/px]: one number or (y, x)
        angle_deg: turns the pixel axes counter-clockwise, x to the right and y up
        flip: columns run the other way (opposite parity)
        center_arcsec (2,): (y, x) of the stamp's centre, pixel ((Ny-1)/2, (Nx-1)/2)

        Raises ValueError for a scale that is not positive.
        """
        shape = _shape(shape)
        scale = np.broadcast_to(np.asarray(scale_arcsec, dtype=np.float64), 2)
        if not (np.isfinite(scale) & (scale > 0)).all():
            raise ValueError(f"scale_arcsec must be positive, not {scale_arcsec}")
        cos, sin = _cos_sin(angle_deg)
        jacobian = np.array([[cos, sin], [-sin, cos]]) * scale * (1, -1 if flip else 1)
        center = np.asarray(center_arcsec, dtype=np.float64)
        return cls(shape, None, jacobian, center - jacobian @ ((np.array(shape) - 1) / 2))

    @property
    def pixel_scale_arcsec(self):
        """Root of the central pixel's area [arcsec], from the WCS evaluated around it."""
        if self.wcs is None:
            return math.sqrt(abs(np.linalg.det(self.jacobian)))
        n, m = (np.array(self.shape) - 1) / 2
        half = np.array([-0.5, 0.5])
        n, m = np.concatenate([n + half, [n, n]]), np.concatenate([[m, m], m + half])
        lon, lat = np.radians(self._world(n, m))
        v = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        return math.sqrt(np.linalg.norm(np.cross(v[:, 1] - v[:, 0], v[:, 3] - v[:, 2]))) / ARCSEC

    def sky(self, n, m):
        """Sky at pixel positions: (y, x) [arcsec] if flat, else (longitude, latitude) [deg].

        n, m: rows and columns, any shapes that broadcast; the centre of a pixel is whole
        returns (2, ...)
        """
        n, m = np.broadcast_arrays(np.asarray(n, dtype=np.float64), np.asarray(m, dtype=np.float64))
        if self.wcs is None:
            return np.tensordot(self.jacobian, np.stack([n, m]), 1) + _column(self.origin, n.ndim)
        return self._world(n, m)

    def pixel(self, a, b):
        """Pixel positions at points of the sky, the inverse of `sky`.

        a, b: y and x [arcsec] if flat, else longitude and latitude [deg] in the WCS's own frame
            (right ascension and declination if that is equatorial); any shapes that broadcast
        returns (..., 2) [px]: (y, x); NaN where the projection holds no such point
        """
        a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
        if self.wcs is None:
            inverse = np.linalg.inv(self.jacobian)
            return (np.stack([a, b], axis=-1) - self.origin) @ inverse.T
        return pixels_at(self.wcs, a.ravel(), b.ravel()).reshape(a.shape + (2,))

    def map_to(self, grid_in, tolerance_px=1e-4):
        """Mapping of this grid's pixels into those of `grid_in`: X = A p + t, or one by one.

        Both WCS are evaluated, celestial frames (ICRS, FK5, galactic, ...) converted; A and t are
        fitted where `grid_in` covers this grid. What the fit leaves decides the kind.

        grid_in: the model's grid; WCS or flat as this one is
        tolerance_px [model px]: largest departure that counts as none

        Raises ValueError when one grid is flat and the other not, when no pixel has a place in
        `grid_in`'s projection, and for a singular Jacobian.
        """
        self._check_like(grid_in, "grid_in")
        if self.wcs is None:
            matrix, offset = _flat_affine(self, grid_in)
            return map_affine(matrix, offset, grid_in.shape, self.shape, tolerance_px)
        return map_positions(
            lambda n, m: positions(self, grid_in, n, m),
            lambda n, m: positions(grid_in, self, n, m),
            grid_in.shape,
            self.shape,
            tolerance_px,
        )

    def cutout(self, y0, x0, shape):
        """Grid of the pixels from (y0, x0) on; they may lie outside this one."""
        shape = _shape(shape)
        if self.wcs is None:
            origin = self.origin + self.jacobian @ (y0, x0)
            return Grid(shape, None, self.jacobian, origin)
        return Grid(shape, shifted_wcs(self.wcs, y0, x0))

    def to_wcs(self, *, ra_deg=0.0, dec_deg=0.0):
        """The WCS; for a flat grid a gnomonic one (ICRS) that touches the sky at (y, x) = (0, 0).

        x grows to the west there (east is left, north up), so that two flat grids placed at the
        same point map into each other exactly as they do flat.

        ra_deg, dec_deg [deg]: where (0, 0) lies; of no effect on a grid that has a WCS
        """
        if self.wcs is not None:
            return self.wcs.deepcopy()
        wcs = WCS(naxis=2)
        wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        wcs.wcs.cunit = ["deg", "deg"]
        wcs.wcs.radesys = "ICRS"
        wcs.wcs.crval = [ra_deg, dec_deg]
        n, m = np.linalg.solve(self.jacobian, -self.origin)
        wcs.wcs.crpix = [m + 1, n + 1]
        # rows (west, north) of columns (m, n), west counted as minus right ascension
        wcs.wcs.cd = self.jacobian[::-1, ::-1] * [[-1], [1]] / 3600
        wcs.wcs.set()
        return wcs

    def _check_like(self, other, name):
        if (self.wcs is None) != (other.wcs is None):
            kinds = ["flat" if grid.wcs is None else "placed by a WCS" for grid in (self, other)]
            raise ValueError(
                f"{name} is {kinds[1]} and this grid {kinds[0]}: give both a WCS (Grid.to_wcs)"
            )

    def _world(self, n, m):
        """(2, ...) longitude and latitude [deg]; NaN where there is none."""
        world = np.array(self.wcs.all_pix2world(np.ravel(m), np.ravel(n), 0))
        return world[[self.wcs.wcs.lng, self.wcs.wcs.lat]].reshape((2,) + np.shape(n))


def positions(grid_from, grid_to, n, m):
    """Pixels (n, m) of grid_from in those of grid_to: (..., 2), (y, x); NaN where there is none."""
    if grid_from.wcs is None:
        matrix, offset = _flat_affine(grid_from, grid_to)
        return np.stack(np.broadcast_arrays(n, m), axis=-1) @ matrix.T + offset
    world = grid_from._world(*np.broadcast_arrays(n, m))
    good = np.isfinite(world).all(axis=0)
    result = np.full(good.shape + (2,), np.nan)
    if not good.any():
        return result
    lon, lat = world[:, good]
    frames = [wcs_to_celestial_frame(grid.wcs) for grid in (grid_from, grid_to)]
    if not frames[0].is_equivalent_frame(frames[1]):
        sky = SkyCoord(lon, lat, unit="deg", frame=frames[0]).transform_to(frames[1]).spherical
        lon, lat = sky.lon.deg, sky.lat.deg
    result[good] = pixels_at(grid_to.wcs, lon, lat)
    return result


def _flat_affine(grid_from, grid_to):
    """A and t from pixels of one flat grid to those of another."""
    matrix = np.linalg.solve(grid_to.jacobian, grid_from.jacobian)
    return matrix, np.linalg.solve(grid_to.jacobian, grid_from.origin - grid_to.origin)


def _shape(shape):
    shape = tuple(int(n) for n in shape)
    if len(shape) != 2 or min(shape) < 1:
        raise ValueError(f"shape must be (Ny, Nx), each at least 1 pixel, not {shape}")
    return shape


def _cos_sin(angle_deg):
    """Exact at the quarter turns, so that these stay aligned."""
    quarter, rest = divmod(angle_deg, 90)
    if rest == 0:
        return ((1, 0), (0, 1), (-1, 0), (0, -1))[int(quarter) % 4]
    return math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))


def _column(vector, n_dim):
    return vector.reshape((2,) + (1,) * n_dim)
