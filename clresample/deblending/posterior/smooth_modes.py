"""Smooth changes of a morphology under the multi-scale prior: Gaussians times its covariance.

    m = sqrt(p) o (P * y),   P = sum_j alpha_j^2 K_j * K_j,   Q^-1_kl = <y_k, P * y_l>

y is a Gaussian. Restricting y to a few Gaussians can only underestimate the errors of the exact
posterior. Every y and K_j is a product of a function of the row and one of the column, so that
images and Q^-1 follow from tables along the two axes.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.linalg.lapack import dtrtri

from ..linear.mode_images import cell_sums

# [model px] Distance of bumps, whose sigma is half of it. FINE_SPACING_PX is used where a source
# overlaps a neighbour, because the data hardly constrain the division of light there. In crowded
# simulated scenes flux errors are 0.99 (median) and 0.92 (5 % quantile) of those from all modes;
# with COARSE_SPACING_PX everywhere they are 0.51 of them in blends.
COARSE_SPACING_PX, FINE_SPACING_PX = 8, 4
# [1] Largest number of bumps of a component: for larger galaxies spacings are doubled until the
# number is not exceeded. The cost grows with its square. A box of 160 pixels a side has 400; the
# light of wider galaxies, and its uncertainty, varies on larger scales.
MAX_MODES = 400
# [1] Modes with less light than this everywhere, relative to the profile's peak, are left out:
# their light is too faint for the division between overlapping sources. Errors use more, see
# modes.py.
MIN_LIGHT = 1e-4
# Number of box sides whose tables are cached, 50 kB each at 30 pixels.
MAX_AXES = 256
# Fraction of a bump's peak that must lie in the overlap.
REACHED = 0.8
# Added to Q^-1, whose diagonal is 1: combinations of overlapping bumps that cancel to less are
# rounding errors, and get no variance.
MIN_SHARE = 1e-6
# Pixels in the sigma of the narrowest bumps that suffice for images of bumps, where wider pixels
# are allowed. With 4, errors of single galaxies of 64 px change by less than 0.5 %.
PIXELS_A_SIGMA = 4
# Elements of a table below this fraction of its largest are set to 0, so that products of three
# tables are not denormals of float32, which take 20 times as long to add.
TINY = 1e-10


class SmoothModes:
    """Modes on the box of one component, on a grid aligned with the frame, which neighbours share.

    n_coarse: number of the wider ones, which come first; pixels (2,) [px]: that suffice for images
        of these, and of the others
    precision (k, k): Q^-1 of their coefficients, with a diagonal of 1
    sides: (k, ny) and (k, nx), whose products are the Gaussians y

    origin (2,) [px]: of the box in the frame; profile (ny, nx); strengths (J,): of the prior's
        scales; kernels: its J kernels; shared (ny, nx): mask of the overlap; all_over: False =
        modes in the overlap only; most: largest number of modes, MAX_MODES by default;
        least_light: see MIN_LIGHT
    """

    def __init__(
        self,
        origin,
        profile,
        strengths,
        kernels,
        shared,
        *,
        all_over=True,
        most=None,
        least_light=MIN_LIGHT,
    ):
        spacings, low = (COARSE_SPACING_PX, FINE_SPACING_PX), None
        while low is None or len(low) > (most or MAX_MODES):
            taps, period = tuple(k.tobytes() for k in kernels), max(spacings)
            axes = [
                _axis(int(o) % period, n, taps, spacings)
                for o, n in zip(origin, profile.shape, strict=True)
            ]
            pairs = zip(*_chosen(axes, profile, shared, all_over, least_light), strict=True)
            low, high = (np.concatenate(part) for part in pairs)
            spacings = tuple(2 * h for h in spacings)
        rows, columns = axes
        self.n_coarse = int((low < rows.fine.start).sum())
        self.pixels = tuple(max(1, h // 4 // PIXELS_A_SIGMA) for h in spacings)
        variance = np.square(strengths)
        gram = rows.gram[:, low[:, None], low] * columns.gram[:, high[:, None], high]
        precision = np.tensordot(variance, gram, 1)
        scale = 1 / np.sqrt(np.maximum(np.diag(precision), 1e-30))
        precision = precision * scale[:, None] * scale
        self.precision = 0.5 * (precision + precision.T)
        along = (variance[:, None] * scale)[:, :, None] * rows.blurred[:, low]
        self._tables = along, columns.blurred[:, high], np.sqrt(np.maximum(profile, 0))
        self.sides = scale[:, None] * rows.values[low], columns.values[high]

    def __len__(self):
        return len(self.precision)

    def images(self, pixel=1, last=None):
        """Images (k, my, mx), float32, of the first `last` modes, or all: means over cells.

        pixel [px]: of the cells, see mode_images.py
        """
        along, across, amplitude = self._tables
        along, across = (
            cell_sums(part[:, :last], pixel, n_axes=1, beyond="edge") / pixel
            for part in (along, across)
        )
        amplitude = cell_sums(amplitude, pixel) / pixel**2
        along, across, amplitude = map(_without_faint, (along, across, amplitude))
        found = along.transpose(1, 2, 0) @ across.transpose(1, 0, 2)
        found *= amplitude
        return found

    def widths(self):
        """Modes of one width: (first, last, pixel) of those from first to last - 1."""
        n, (wide, narrow) = self.n_coarse, self.pixels
        if n in (0, len(self)) or wide == narrow:
            return [(0, len(self), wide if n else narrow)]
        return [(0, n, wide), (n, len(self), narrow)]


def whitening_transform(precision):
    """Combinations (k, k) of modes whose coefficients are independent with unit variance.

    Those of the modes have the inverse covariance `precision` (k, k); 0 above the diagonal.
    """
    if not len(precision):
        return precision
    lower = np.linalg.cholesky(precision + MIN_SHARE * np.eye(len(precision)))
    return dtrtri(lower, lower=1)[0]


def _without_faint(table):
    """A table in float32, with TINY values set to 0."""
    size = np.abs(table)
    return np.where(size > TINY * size.max(initial=0), table, 0).astype(np.float32)


@functools.lru_cache(maxsize=MAX_AXES)
def _axis(origin, n, taps, spacings):
    """The _Axis of kernels that come as bytes: one for all boxes of this side."""
    return _Axis(origin, n, [np.frombuffer(k) for k in taps], spacings)


class _Axis:
    """Gaussians along one side of a box, of both spacings one after the other.

    coarse, fine: slices of them; values (k, n), blurred (J, k, n): by each K_j twice;
    gram (J, k, k): <values, blurred>
    """

    def __init__(self, origin, n, kernels, spacings):
        parts = [_gaussians(origin, n, h) for h in spacings]
        n_coarse = len(parts[0])
        self.values = np.concatenate(parts)
        self.coarse, self.fine = slice(n_coarse), slice(n_coarse, None)
        self.blurred = np.array([_blur(self.values, np.convolve(k, k)) for k in kernels])
        self.gram = self.blurred @ self.values.T


def _gaussians(origin, n, h):
    """Gaussians (k, n) of width h / 2 every h pixels of the frame, one past both ends."""
    at = np.arange(origin // h * h - h, origin + n + 2 * h, h) - origin
    return np.exp(-0.5 * ((np.arange(n) - at[:, None]) / (0.5 * h)) ** 2)


def _blur(values, taps):
    """Rows (k, n) under a kernel of odd length, zero beyond their ends."""
    lag = np.arange(values.shape[1])
    lag = lag - lag[:, None] + len(taps) // 2
    inside = (lag >= 0) & (lag < len(taps))
    return values @ np.where(inside, taps[np.clip(lag, 0, len(taps) - 1)], 0)


def _chosen(axes, profile, shared, all_over, least_light):
    """Pairs of indices (k,), (k,) of rows and columns: coarse modes, and fine ones where shared.

    Coarse ones lie all over the profile or where shared; none has less light anywhere than
    least_light.
    """
    rows, columns = axes
    for which, where in (("coarse", None if all_over else shared), ("fine", shared)):
        if where is not None and not where.any():
            continue
        a, b = (getattr(axis, which) for axis in axes)
        keep = _most(rows.values[a], columns.values[b], profile) > least_light
        if where is not None:
            keep &= _most(rows.values[a], columns.values[b], where) > REACHED
        low, high = np.nonzero(keep)
        yield low + (a.start or 0), high + (b.start or 0)


def _most(rows, columns, image):
    """Largest pixel (k, l) of each product of a row and a column with an image (ny, nx).

    Rows (k, ny) and columns (l, nx), none of them negative.
    """
    by_row, near = np.empty((len(rows), image.shape[1])), rows > TINY
    ends = zip(near.argmax(1), rows.shape[1] - near[:, ::-1].argmax(1), strict=True)
    for row, most, (low, high) in zip(rows[:, :, None], by_row, ends, strict=True):
        (row[low:high] * image[low:high]).max(0, out=most)
    return (by_row[:, None] * columns).max(2)
