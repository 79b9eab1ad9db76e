"""Sparse interpolation along straight lines through the model, and at any points of it."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

# Terms of the Chebyshev series of one tap: with 14 the error is 1e-14, the rounding of float64.
# More terms only cost time.
SERIES_TERMS = 16


@dataclass(frozen=True)
class KaiserBessel:
    """Kaiser-Bessel window: interpolates a band-limited line from samples on finer columns.

        phi(u) = I0(beta sqrt(1 - (2u/W)^2)) / I0(beta),   |u| <= W/2, else 0
        phi^(f) = W sinh(b) / (b I0(beta)),   b^2 = beta^2 - (pi W f)^2

    n_taps: W, columns that a pixel is interpolated from
    oversampling: how many times closer the columns lie than Nyquist's spacing
    Relative error of the interpolation: 2 b exp(-b) with b = pi W sqrt(1 - 1/oversampling) at the
    band's end, and less inside.
    """

    n_taps: int
    oversampling: float

    @property
    def beta(self) -> float:
        """The shape for which the main lobe of phi^ ends where the band's first alias begins."""
        return np.pi * self.n_taps * (1 - 0.5 / self.oversampling)

    def __call__(self, u):
        """phi(u) (...) at distances u (...) [columns]."""
        inside = np.clip(1 - (2 * u / self.n_taps) ** 2, 0, None)
        return np.i0(self.beta * np.sqrt(inside)) / self._peak * (inside > 0)

    def taps(self, fraction):
        """phi(fraction + W/2 - 1 - t), t = 0 .. W - 1: (..., W), for fraction (...) in [0, 1).

        phi has no singularity inside its support. So a Chebyshev series for each tap is exact to
        rounding, and 20 times as fast as the Bessel function.
        """
        return np.polynomial.chebyshev.chebvander(2 * fraction - 1, SERIES_TERMS - 1) @ self._series

    @functools.cached_property
    def _peak(self):
        """I0(beta)."""
        return float(np.i0(self.beta))

    @functools.cached_property
    def _series(self):
        """Chebyshev coefficients (SERIES_TERMS, W) of phi at each tap."""
        node = (np.arange(SERIES_TERMS) + 0.5) * (np.pi / SERIES_TERMS)
        tap = np.arange(self.n_taps)
        samples = self((np.cos(node)[:, None] + 1) / 2 + self.n_taps / 2 - 1 - tap)
        series = np.cos(np.outer(np.arange(SERIES_TERMS), node)) @ samples * (2 / SERIES_TERMS)
        series[0] /= 2
        return series

    def transform(self, f):
        """phi^(f) (...) at frequencies f (...) [cycles/column]."""
        b = np.sqrt((self.beta**2 - (np.pi * self.n_taps * f) ** 2).clip(1e-300))
        return self.n_taps * np.sinh(b) / (b * self._peak)


@dataclass(frozen=True, eq=False)
class LineTaps:
    """Observed pixels as straight lines through the model: pass 2 of the affine geometry.

        forward   out[l, q] = sum_t weight[l, t, q] g[l, start[l, q] + t]
        adjoint   g[l, j] = sum_t weight_t[l, t, j] out[l, start_t[l, j] + t]

    by_row: lines are rows of the observed image (position q = column) or its columns (q = row)
    start (L, Q), start_t (L, J): first of the columns, or pixels, that are summed
    weight (L, W, Q), weight_t (L, W', J) [1]: 0 for pixels that the model does not cover
    covered (L, Q): bool, these; n_columns: J
    """

    by_row: bool
    start: np.ndarray
    weight: np.ndarray
    covered: np.ndarray
    n_columns: int

    @functools.cached_property
    def _back(self):
        weight = self.weight.swapaxes(1, 2)
        return transpose_taps(self.start, weight, self.covered, self.n_columns)

    @property
    def n_bytes(self) -> int:
        """Host memory [bytes] of the present tables."""
        parts = self.start, self.weight, self.covered, *vars(self).get("_back", ())
        return sum(part.nbytes for part in parts)

    @property
    def start_t(self) -> np.ndarray:
        """Computed at its first use, which rendering does not need."""
        return self._back[0]

    @property
    def weight_t(self) -> np.ndarray:
        """As start_t."""
        return self._back[1]


@dataclass(frozen=True, eq=False)
class PointTaps:
    """Observed pixels anywhere on the model, from the rows and columns of a finer plane g.

        out[pixel[q]] = sum_ts weight[q, 0, t] weight[q, 1, s] g[start[q, 0] + t, start[q, 1] + s]

    pixel (Q,): those that the model covers, in the order of their first rows and columns
    start (Q, 2): first of the rows, and of the columns, that are summed
    weight (Q, 2, W) [1]: of rows, times the pixel's area, and of columns
    """

    pixel: np.ndarray
    start: np.ndarray
    weight: np.ndarray

    @property
    def n_taps(self) -> int:
        """W."""
        return self.weight.shape[2]

    @property
    def n_bytes(self) -> int:
        """Host memory [bytes]."""
        return self.pixel.nbytes + self.start.nbytes + self.weight.nbytes


def transpose_taps(start, weight, covered, n_columns):
    """The same sparse lines read the other way: for each column, the observed pixels it feeds.

    start (L, Q), weight (L, Q, W): of the way forward; covered (L, Q) bool
    returns start_t (L, J), weight_t (L, W', J) for J = n_columns
    """
    n_lines, n_steps, n_taps = weight.shape
    line, step = np.nonzero(covered)
    column = (line * n_columns + start[line, step])[:, None] + np.arange(n_taps)  # of all lines
    steps = np.broadcast_to(step[:, None], column.shape).ravel()
    first = np.full(n_lines * n_columns, n_steps - 1)
    last = np.zeros(n_lines * n_columns, dtype=int)
    np.minimum.at(first, column.ravel(), steps)
    np.maximum.at(last, column.ravel(), steps)
    n_back = max(int((last - first).max()) + 1, 1)
    first = np.minimum(first, n_steps - n_back)
    # element (line, step - first, column) of the result, counted along its flat array
    tap = line[:, None] * (n_back - 1) + step[:, None] - first[column]
    back = np.zeros(n_lines * n_back * n_columns)
    back[tap * n_columns + column] = weight[covered]
    return first.reshape(n_lines, n_columns), back.reshape(n_lines, n_back, n_columns)
