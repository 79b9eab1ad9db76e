"""Mappings between two pixel grids: aligned, affine, or position by position."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

# [px] Rounding of two WCS in float64 (up to 1e-8 at 0.01 arcsec). Mappings this near to whole
# pixels are rounded to them, and centres this near to an edge count as on it.
NOISE_PX = 1e-6
# Points per axis at which two WCS are compared. SIP and TPV polynomials have at most order 9, for
# which half as many points suffice; more only cost time.
N_LATTICE = 33
# [px] positions evaluated at once, 8 MiB per axis: larger blocks only take more memory
BLOCK = 1 << 20
# |det A| / |A|^2 below which A is singular: its float64 inverse has no correct digit of a pixel.
SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class Mapping:
    """Observed pixels p = (n, m) in the model's pixels: X(p) = A p + t, or X listed one by one.

    shape_in (Ny, Nx), shape_out (My, Mx) [px]: model, observed
    matrix (2, 2) [model px / observed px]: A, rows (y, x), columns (n, m)
    offset (2,) [model px]: t
    geometry: "aligned" (A exactly diagonal or anti-diagonal), "affine" or "distorted"
    departure_px [model px]: largest distance of the true mapping from A p + t
    positions (My, Mx, 2) [model px]: (y, x) when distorted, else None; pixels outside the model's
        projection get a position outside the model
    area (My, Mx): |det J| / |det A| of the true mapping when distorted, else None
    """

    shape_in: tuple
    shape_out: tuple
    matrix: np.ndarray
    offset: np.ndarray
    geometry: str
    departure_px: float
    positions: np.ndarray | None = None
    area: np.ndarray | None = None

    def at(self, n, m):
        """Positions (..., 2) [model px] of observed pixels; whole ones inside when distorted."""
        n, m = np.broadcast_arrays(n, m)
        if self.geometry == "distorted":
            return self.positions[n, m]
        return np.stack([n, m], axis=-1) @ self.matrix.T + self.offset

    @property
    def covered(self):
        """(My, Mx) bool: observed pixels whose centre lies on the model, [-1/2, N - 1/2].

        Centres on the edge are included, regardless of rounding in the two WCS.
        """
        return self._within(NOISE_PX)

    def _within(self, reach_px):
        """(My, Mx) bool: observed pixels whose centre lies on the model or as near to its edge."""
        low, high = -0.5 - reach_px, np.array(self.shape_in) - 0.5 + reach_px
        if self.geometry == "distorted":
            return ((self.positions >= low) & (self.positions <= high)).all(axis=-1)
        n, m = (np.arange(n, dtype=np.float64) for n in self.shape_out)
        inside = np.ones(self.shape_out, dtype=bool)
        for (a, b), t, top in zip(self.matrix, self.offset, high, strict=True):
            x = a * n[:, None] + (b * m + t)
            inside &= (x >= low) & (x <= top)
        return inside

    def on_pixels(self, pixel):
        """This mapping to a model with pixels of a side `pixel` [px], not for distorted ones.

        The model has the same corner. Its last pixels may end beyond the present ones.
        """
        return replace(
            self,
            shape_in=tuple(-(-n // pixel) for n in self.shape_in),
            matrix=self.matrix / pixel,
            offset=on_wide_pixels(self.offset, pixel),
            departure_px=self.departure_px / pixel,
        )

    def window(self, in_origin, in_shape, out_origin, out_shape, *, tolerance_px=None):
        """Mapping between a cutout of the observed pixels and a cutout of the model.

        in_origin, in_shape (2,) [model px]; out_origin, out_shape (2,) [observed px]
        tolerance_px [model px]: when given, a distorted mapping becomes affine where the cutout
            allows it

        Raises ValueError when the observed cutout leaves a distorted mapping.
        """
        (y0, x0), (n_y, n_x) = out_origin, out_shape
        in_origin = np.asarray(in_origin, dtype=np.float64)
        cut = replace(
            self,
            shape_in=tuple(in_shape),
            shape_out=tuple(out_shape),
            offset=self.matrix @ (y0, x0) + self.offset - in_origin,
        )
        if self.geometry != "distorted":
            return cut
        if min(y0, x0) < 0 or y0 + n_y > self.shape_out[0] or x0 + n_x > self.shape_out[1]:
            raise ValueError(
                f"out_origin {tuple(out_origin)} and out_shape {tuple(out_shape)} leave the "
                f"{self.shape_out} observed pixels of a distorted mapping"
            )
        part = (slice(y0, y0 + n_y), slice(x0, x0 + n_x))
        cut = replace(cut, positions=self.positions[part] - in_origin, area=self.area[part])
        covered = cut.covered
        if tolerance_px is None or not covered.any():
            return cut
        points = np.argwhere(covered).astype(np.float64)
        if not _spans(points):
            return cut
        geometry, matrix, offset, departure = _decide(points, cut.positions[covered], tolerance_px)
        if geometry == "distorted":
            return cut
        return Mapping(cut.shape_in, cut.shape_out, matrix, offset, geometry, departure)


@dataclass(frozen=True, eq=False)
class PaddedMapping(Mapping):
    """Mapping that also covers observed pixels up to `reach_px` [model px] beyond the model.

    part: first row and column of the pixels that may be covered, and those after the last; None:
        all
    """

    reach_px: float = 0.0
    part: tuple[int, int, int, int] | None = None

    @classmethod
    def for_box(cls, mapping, shape, reach_px, size=None):
        """The pixels centred on a box of this shape (2,) [px]; not for distorted mappings.

        There is half a pixel more on each side, for boxes whose middle is off by half a pixel.

        size (2,): number of pixels, if larger than needed; the additional pixels are not covered
        """
        own = cls.window_size(mapping, shape, reach_px)
        size = own if size is None else np.array(size)
        before = (size - own) // 2
        offset = (np.array(shape) - 1) / 2 - mapping.matrix @ (before + (own - 1) / 2)
        return cls(
            tuple(shape),
            tuple(size.tolist()),
            mapping.matrix,
            offset,
            mapping.geometry,
            mapping.departure_px,
            reach_px=reach_px + np.abs(mapping.matrix).sum() / 2,
            part=(*before.tolist(), *(before + own).tolist()),
        )

    @staticmethod
    def window_size(mapping, shape, reach_px):
        """Number of pixels (2,) that `for_box` needs."""
        inverse = np.abs(np.linalg.inv(mapping.matrix))
        return np.ceil(inverse @ (np.array(shape) + 2 * reach_px)).astype(int) + 1

    @classmethod
    def of(cls, mapping, shape, margin):
        """A mapping to a model with this many pixels around a box of `shape`, as one to the box."""
        positions = mapping.positions
        return cls(
            tuple(shape),
            mapping.shape_out,
            mapping.matrix,
            mapping.offset - margin,
            mapping.geometry,
            mapping.departure_px,
            None if positions is None else positions - margin,
            mapping.area,
            reach_px=margin,
        )

    @functools.cached_property
    def covered(self):
        """(My, Mx) bool: observed pixels whose centre lies within reach of the model."""
        inside = self._within(self.reach_px)
        if self.part is not None:
            y0, x0, y1, x1 = self.part
            inside[:y0] = inside[y1:] = inside[:, :x0] = inside[:, x1:] = False
        return inside


def on_wide_pixels(position, pixel):
    """Positions [px] from a corner's pixel on, in pixels of a side `pixel` [px] from there on."""
    return (position + 0.5) / pixel - 0.5


def lattice(low, shape):
    """Positions n, m (N, M) over a box of pixels, from outer edge to outer edge.

    low, shape (2,) [px]: its first pixel, and its size; N_LATTICE points per axis, fewer if small
    """
    axes = [
        np.linspace(start - 0.5, start + n - 0.5, min(n + 1, N_LATTICE))
        for start, n in zip(low, shape, strict=True)
    ]
    return np.meshgrid(*axes, indexing="ij")


def map_affine(matrix, offset, shape_in, shape_out, tolerance_px):
    """Mapping of the simplest sufficient geometry for X(p) = A p + t, exact unless it is snapped.

    matrix (2, 2), offset (2,): A and t; shape_in, shape_out (2,) [px]: model, observed

    Raises ValueError for a singular A.
    """
    points = np.stack(lattice((0, 0), shape_out), axis=-1).reshape(-1, 2)
    true = points @ matrix.T + offset
    geometry, snapped, shift, departure = _decide(points, true, tolerance_px, matrix)
    if (snapped == matrix).all() and (shift != np.rint(shift)).any():
        shift, departure = offset, 0.0
    return Mapping(shape_in, shape_out, snapped, shift, geometry, departure)


def map_positions(forward, backward, shape_in, shape_out, tolerance_px):
    """Mapping of the simplest sufficient geometry for the true positions `forward(n, m)`.

    forward, backward: functions of broadcast (n, m), observed to model and back, to (..., 2)
        positions, NaN where there is none
    shape_in, shape_out (2,) [px]: model, observed

    Raises ValueError when no observed pixel has a position, and for a singular Jacobian.
    """
    # only pixels on the model matter: the model of a stamp overlaps few pixels of a whole frame
    low, shape = _met(backward(*lattice((0, 0), shape_in)), shape_out)
    n, m = lattice(low, shape)
    true = forward(n, m)
    good = np.isfinite(true).all(axis=-1)
    points = np.stack([n, m], axis=-1)[good]
    if not _spans(points):
        raise ValueError("grids do not overlap: grid_in's projection contains none of these pixels")
    geometry, matrix, offset, departure = _decide(points, true[good], tolerance_px)
    if geometry != "distorted" and good.all():
        return Mapping(shape_in, shape_out, matrix, offset, geometry, departure)
    positions, area = _evaluate(forward, shape_in, shape_out, abs(np.linalg.det(matrix)))
    return Mapping(shape_in, shape_out, matrix, offset, "distorted", departure, positions, area)


def _met(corners, shape_out):
    """Origin and shape of the observed pixels within the model's outline; all if none are."""
    whole = (0, 0), shape_out
    corners = corners[np.isfinite(corners).all(axis=-1)]
    if not len(corners):
        return whole
    # one pixel of margin for the curvature of an outline between the points of the lattice
    low = np.maximum(np.floor(corners.min(axis=0)) - 1, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)) + 1, np.array(shape_out) - 1)
    if (high < low).any():
        return whole
    return low.astype(int), (high - low + 1).astype(int)


def _spans(points):
    """Returns True if an affine mapping can be fitted to these points (L, 2)."""
    return len(points) > 2 and np.linalg.matrix_rank(points - points[0]) == 2


def _decide(points, true, tolerance_px, matrix=None):
    """Geometry, matrix, offset, departure of the simplest mapping from points to true (L, 2)."""
    tolerance_px = max(tolerance_px, NOISE_PX)
    if matrix is None:
        middle = (points.max(axis=0) + points.min(axis=0)) / 2
        design = np.column_stack([points - middle, np.ones(len(points))])
        matrix = np.linalg.lstsq(design, true, rcond=None)[0][:2].T.copy()
    det = abs(np.linalg.det(matrix))
    if not det > SINGULAR * np.sum(matrix**2):
        raise ValueError(f"the Jacobian between the two grids is singular: {matrix.tolist()}")
    diagonal = abs(matrix[0, 0] * matrix[1, 1]) >= abs(matrix[0, 1] * matrix[1, 0])
    aligned = np.where(np.eye(2) == diagonal, matrix, 0.0)
    offset, departure = _centred(points, true, aligned)
    if departure <= tolerance_px:
        whole = np.rint(aligned) + 0.0, np.rint(offset) + 0.0  # no -0
        moved = _departure(points, true, *whole)
        if moved <= NOISE_PX:
            return "aligned", *whole, moved
        return "aligned", aligned, offset, departure
    offset, departure = _centred(points, true, matrix)
    return "affine" if departure <= tolerance_px else "distorted", matrix, offset, departure


def _centred(points, true, matrix):
    """Offset (2,) [px] with equal errors in both directions of each axis; largest distance."""
    rest = true - points @ matrix.T
    offset = (rest.max(axis=0) + rest.min(axis=0)) / 2
    return offset, _departure(points, true, matrix, offset)


def _departure(points, true, matrix, offset):
    """Largest distance [px] of points (L, 2) mapped by A and t from true (L, 2)."""
    return float(np.hypot(*(true - points @ matrix.T - offset).T).max())


def _evaluate(forward, shape_in, shape_out, det):
    """Positions (My, Mx, 2) and relative area (My, Mx) of every pixel, blocks of rows at a time."""
    n_y, n_x = shape_out
    positions = np.empty((n_y, n_x, 2))
    area = np.empty(shape_out)
    m = np.arange(-1.0, n_x + 1)  # one ring more, so that every difference is central
    n_rows = max(1, BLOCK // (n_x + 2))
    for i in range(0, n_y, n_rows):
        n = np.arange(i - 1.0, min(i + n_rows, n_y) + 1)
        block = forward(n[:, None], m[None])
        rows = slice(i, i + len(n) - 2)
        positions[rows] = block[1:-1, 1:-1]
        (dy_n, dx_n) = np.moveaxis(block[2:, 1:-1] - block[:-2, 1:-1], -1, 0) / 2
        (dy_m, dx_m) = np.moveaxis(block[1:-1, 2:] - block[1:-1, :-2], -1, 0) / 2
        area[rows] = np.abs(dy_n * dx_m - dy_m * dx_n) / det
    lost = ~np.isfinite(positions).all(axis=-1)
    positions[lost] = -np.array(shape_in, dtype=np.float64)  # outside the model: never covered
    area[lost | ~np.isfinite(area)] = 0
    return positions, area
