"""Tables of waves at the pixels of each geometry, in float64; see ResamplingPlan."""

from __future__ import annotations

import numpy as np

from ..device.rounding import round_up
from ..sky.fourier import cos_sin_columns, uniform_waves
from ..sky.mapping import Mapping
from .gridding import KaiserBessel, LineTaps, PointTaps

# Sums over taps are padded to a multiple of this on CPUs, whose vectors have four elements or more.
TAPS_PAD = 4


def wave_table(nu, x) -> np.ndarray:
    """Columns 2i, 2i+1: cos and sin of 2 pi nu_i x (..., 2 len(nu)) for positions x (...)."""
    return cos_sin_columns(2 * np.pi * np.asarray(x)[..., None] * nu)


def uniform_wave_table(nu, first, step, n) -> np.ndarray:
    """`wave_table` (n, 2 len(nu)) at equal distances, x = first + step k; faster."""
    return uniform_waves(nu, first, step, n).view(np.float64)


def aligned_tables(mapping: Mapping, nu, axes, center):
    """Waves at the observed rows and columns, relative to their middle; 0 outside the model.

    Also returns the distance of that middle from the model's (2,) [model px].
    """
    tables, middle = [], []
    for i in (0, 1):
        axis, n = axes[i], mapping.shape_out[i]
        step = mapping.matrix[axis, i]
        reach = step * (n - 1) / 2
        table = uniform_wave_table(nu[i], -reach, step, n)
        tables.append(table * mapping.covered.any(axis=1 - i)[:, None])
        middle.append(mapping.offset[axis] + reach - center[axis])
    return {"out_y": tables[0], "out_x": tables[1].T}, middle


def point_tables(mapping: Mapping, nu, d, center, window: KaiserBessel):
    """Observed pixels as points of a finer plane, from which they are interpolated on both axes.

    Rows and columns of the plane lie along the model's, about the middle of the covered pixels, and
    window.oversampling times closer than Nyquist's spacing. Returns (tables, d, middle): d divided
    by the window's transform, and the distance of that middle from the model's (2,) [model px].
    """
    covered = mapping.covered
    x = mapping.at(*np.nonzero(covered)) - center
    low, high = x.min(axis=0), x.max(axis=0)
    nu_max = np.array([max(own[-1], np.finfo(float).tiny ** 0.5) for own in nu])
    spacing = np.minimum(1 / (2 * nu_max * window.oversampling), float(max(mapping.shape_in)))
    both = np.concatenate([-nu[1][:0:-1], nu[1]])
    d = d / (window.transform(nu[0] * spacing[0])[:, None] * window.transform(both * spacing[1]))

    u = (x - low) / spacing
    start = np.floor(u).astype(int)
    weight = window.taps(u - start)
    if mapping.area is not None:
        weight[:, 0] *= mapping.area[covered][:, None]
    # kernels for CPUs read whole vectors of taps
    side = np.ceil((high - low) / spacing).astype(int) + 1 + round_up(window.n_taps, TAPS_PAD)
    order = np.lexsort(start.T[::-1])
    first = low - (window.n_taps / 2 - 1) * spacing  # position of the plane's first row and column
    reach = spacing * (side - 1) / 2
    out_y, out_x = (
        uniform_wave_table(*own) for own in zip(nu, -reach, spacing, side.tolist(), strict=True)
    )
    points = PointTaps(np.flatnonzero(covered)[order], start[order], weight[order])
    return {"out_y": out_y, "out_x": out_x.T, "points": points}, d, first + reach


def line_tables(mapping: Mapping, nu, d, center, window: KaiserBessel):
    """Observed rows (or columns) as lines y = y0 + r x through the model, and pass 2 along them.

    Along a line a plane wave has the single frequency nu_x + r nu_y.  It is sampled on columns
    window.oversampling times finer than its Nyquist spacing, and divided by the window's transform.
    Returns (tables, d, middle): the lines' waves are relative to the middle line, which has the
    distance `middle` (2,) [model px, along the table axes] from the model's middle.
    """
    slope = np.abs(mapping.matrix[1]) / np.linalg.norm(mapping.matrix, axis=0)
    by_row = slope[1] >= slope[0]
    i_line, i_step = (0, 1) if by_row else (1, 0)
    (a, b), (c, e) = mapping.matrix[:, [i_line, i_step]]
    n_lines, n_steps = mapping.shape_out[i_line], mapping.shape_out[i_step]
    r = b / e
    t_y, t_x = mapping.offset - center
    covered = mapping.covered if by_row else mapping.covered.T

    nu_x_both = np.concatenate([-nu[1][:0:-1], nu[1]])
    along = nu_x_both + r * nu[0][:, None]
    nu_max = max(np.abs(along[(d != 0).any(axis=0)]).max(), np.finfo(float).tiny ** 0.5)
    spacing = min(1 / (2 * nu_max * window.oversampling), float(max(mapping.shape_in)))
    reach = (a - r * c) * (n_lines - 1) / 2
    d = d / window.transform(along * spacing)

    x = c * np.arange(n_lines)[:, None] + e * np.arange(n_steps) + t_x
    x_first, x_last = x[covered].min(), x[covered].max()
    u = (x - x_first) / spacing + window.n_taps / 2
    n_columns = int(np.ceil((x_last - x_first) / spacing)) + window.n_taps + 1
    column0 = x_first - window.n_taps / 2 * spacing

    below = np.floor(u - window.n_taps / 2)
    start = np.where(covered, below.astype(int) + 1, 0)
    weight = window.taps(u - window.n_taps / 2 - below) * covered[:, :, None]
    return (
        {
            "out_y": uniform_wave_table(nu[0], -reach, a - r * c, n_lines),
            "out_x": uniform_wave_table(nu[1], column0, spacing, n_columns).T,
            "twist": uniform_waves(nu[0], r * column0, r * spacing, n_columns).T,
            "lines": LineTaps(bool(by_row), start, weight.swapaxes(1, 2), covered, n_columns),
        },
        d,
        (t_y - r * t_x + reach, 0.0),
    )
