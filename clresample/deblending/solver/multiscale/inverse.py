"""Inverse curvature of each source, in blocks of the coefficients that its data determine.

Coefficients of neighbouring positions and of several scales describe the same light, so that the
curvature is far from diagonal. With a diagonal preconditioner L-BFGS takes a hundred iterations and
more for a bright galaxy, with these blocks ten to thirty. For a source of profile p and spectrum A

    H = 1 / alpha^2 + U^T T U,    U = sqrt(p) o K_j less its part along p,    T = sum_c A_c^2 T_c

T_c (evidence.py) is used for the whole box. A source of many coefficients has a block for each part
of its box, to which blocks of its coarser scales, which extend further, are added. The inverse is
then wrong by a factor of a hundred for its widest waves, and without these by thousands. Other
sources, edges and the spectra are not in the blocks; L-BFGS accounts for them. Such a source also
has a ScaleDirection, see scale_direction.py. All are computed in NumPy on the host, at the start
and after updates of strengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lapack

from ....device.rounding import round_up
from .evidence import N_FREQUENCIES
from .prior import kernel_rows
from .scale_direction import ScaleDirection, scale_coefficients

# Smallest ratio of the data's curvature to the prior's for coefficients in blocks. With 3 the
# blocks take a tenth more of a fit's time, without fewer iterations; with 100, fits need half as
# many iterations again.
MIN_DATA_TO_PRIOR = 10.0
# Largest number of coefficients of a block: its time grows with the cube, its memory with the
# square. With fewer, fits of large sources need more iterations. Kernels have four numbers of each
# in local memory, of which devices have at least 32 KiB.
MAX_BLOCK_SIZE = 512
# [px] Largest binning of pixels, otherwise the steps of a block's finest scale. A binning of 2
# changes the curvature of single directions by up to a factor of 1.9, 4 by up to 5. Blocks of wide
# waves over large boxes, with more binned pixels than MAX_PIXELS, are binned more, to limit time
# and memory.
COARSEST, MAX_PIXELS = 2, 3000
# Number of binned pixels from which T is applied by transforms, which at 2000 pixels take a third
# of the time of a matrix product; below it the matrix is faster, unless it is for a single image.
# Then the number of images that are transformed at a time.
MANY_PIXELS, TOGETHER = 1200, 32
# A block uses the pixels where one of its coefficients has more than this fraction of its largest
# value. It is recomputed if the logarithm of a strength, or the spectrum relative to its largest
# value, has changed by more than CHANGE: with 0.35 fits of simulated scenes take a tenth more time
# and equally many rounds; with 2, some more rounds.
MIN_RELATIVE_SIZE, CHANGE = 0.1, 1.0
# Rows of a factor that are stored with one length, for a CPU's vectors.
PANEL = 8


@dataclass(frozen=True, eq=False)
class CurvatureBlock:
    """The inverse W^T W of a part of H, of m coefficients.

    level: see SourceBlocks
    indices (m,): of the coefficients among all of the source's, scale by scale
    cholesky: W, lower triangular, in panels, see `_panels`
    """

    level: int
    indices: np.ndarray
    cholesky: np.ndarray


@dataclass(frozen=True, eq=False)
class SourceBlocks:
    """The inverse curvature of one source; a fixed one has no blocks.

    blocks: CurvatureBlocks. Those of one level have no coefficient in common; the results of levels
        are added
    direction: ScaleDirection of a source of several blocks at level 0; None for others
    """

    blocks: tuple[CurvatureBlock, ...] = ()
    direction: ScaleDirection | None = None


class BlockPreconditioner:
    """The blocks of one free source.

    evidence: its SourceEvidence; profile (ny, nx); light [j]: about its coefficients (ny_j, nx_j),
        see evidence.blurred_light
    """

    def __init__(self, evidence, profile, light):
        self._evidence, self._light = evidence, light
        self._profile = np.asarray(profile, np.float32)
        self._root = evidence.prior.amplitude(self._profile)
        self._power = (self._profile**2).sum()
        self._at = self._blocks = None

    def blocks(self, strengths, spectrum):
        """The SourceBlocks near strengths (J,) and a spectrum (C,)."""
        if self._at is None or self._moved(strengths, spectrum):
            self._at = strengths.copy(), spectrum.copy()
            self._blocks = self._made(*self._at)
        return self._blocks

    def _moved(self, strengths, spectrum):
        before = self._at
        more = np.abs(spectrum - before[1]).max() > CHANGE * np.abs(before[1]).max()
        return more or np.abs(np.log(strengths / before[0])).max() > CHANGE

    def _made(self, strengths, spectrum):
        """The SourceBlocks at these strengths and spectrum."""
        data = np.square(strengths) * self._evidence.curvature(spectrum)
        heard = [
            np.argwhere(part * light > MIN_DATA_TO_PRIOR) for part, light in zip(data, self._light)
        ]
        scale = np.repeat(np.arange(len(heard)), [len(h) for h in heard])
        rows = np.column_stack([scale, np.concatenate(heard)])
        steps, found = np.array(self._evidence.prior.steps), []
        for level in range(len(heard)):
            parts = _split(rows, rows[:, 1:] * steps[rows[:, :1]])
            for own in parts:
                curvature = self._curvature(own, spectrum)
                root = _root(curvature, strengths[own[:, 0]] ** -2)
                found.append(CurvatureBlock(level, self._places(own), root))
            if len(parts) < 2:
                break
            rows = rows[rows[:, 0] > rows[:, 0].min()]
        is_split = sum(block.level == 0 for block in found) > 1
        direction = self._scale_direction(strengths, spectrum) if is_split else None
        return SourceBlocks(tuple(found), direction)

    def _scale_direction(self, strengths, spectrum):
        """The ScaleDirection (all coefficients,), of curvature 1 in the prior and data together."""
        z, change = scale_coefficients(self._evidence.prior, self._profile, strengths)
        seen = seen_through(self._evidence.sharpness(spectrum), change[None], 1)
        curvature = sum((part**2).sum() / a**2 for part, a in zip(z, strengths, strict=True))
        curvature += max(seen[0] @ change.ravel(), 0)
        return ScaleDirection(np.concatenate([part.ravel() for part in z]) / np.sqrt(curvature))

    def _places(self, rows):
        """Indices of coefficients (m, 3) of scale, y, x among all of the source's."""
        first = np.cumsum([0, *(light.size for light in self._light[:-1])])
        width = np.array([light.shape[1] for light in self._light])
        scale, y, x = rows.T
        return first[scale] + y * width[scale] + x

    def _curvature(self, rows, spectrum):
        """U^T T U (m, m) of coefficients (m, 3), by scale, on binned pixels."""
        prior, scales = self._evidence.prior, np.unique(rows[:, 0])
        step = min(COARSEST, *(prior.steps[j] for j in scales))
        reach = max(prior.radii[j] for j in scales)
        at = rows[:, 1:] * np.array(prior.steps)[rows[:, :1]]
        low = np.maximum(at.min(0) - reach, 0)
        high = np.minimum(at.max(0) + reach + 1, self._profile.shape)
        while (-(-(high - low) // step)).prod() > MAX_PIXELS:
            step *= 2
        window = tuple(map(slice, low, high))
        u = [self._seen(j, rows[rows[:, 0] == j, 1:], window, step) for j in scales]
        u = np.concatenate(u)
        size = np.abs(u)
        near = (size >= MIN_RELATIVE_SIZE * size.max((1, 2), keepdims=True)).any(0)
        y, x = (np.flatnonzero(near.any(axis)) for axis in (1, 0))
        u = u[:, y[0] : y[-1] + 1, x[0] : x[-1] + 1]
        seen = seen_through(self._evidence.sharpness(spectrum), u, step)
        return seen @ u.reshape(len(rows), -1).T

    def _seen(self, j, places, window, step):
        """Columns of U, of scale j and places (m, 2), in a window of the box and binned."""
        p, (y, x) = self._profile, places.T
        along_y, along_x = (kernel_rows(self._evidence.prior, j, n) for n in p.shape)
        first, of_x = np.unique(x, return_inverse=True)
        rows = self._root[window][:, None] * along_x[first][:, window[1]]
        rows = _binned(rows, 2, step)[:, of_x].swapaxes(0, 1)  # (m, ny, nx / step)
        u = _binned(along_y[y][:, window[0], None] * rows, 1, step)
        along = (along_y @ (p * self._root) @ along_x.T)[y, x] / self._power
        return u - along[:, None, None] * _binned(_binned(p[window], 0, step), 1, step)


def _split(rows, places):
    """Parts of rows (n, 3) at places (n, 2) [px], at most MAX_BLOCK_SIZE neighbours each.

    Rows keep their order within a part.
    """
    if len(rows) <= MAX_BLOCK_SIZE:
        return [rows] if len(rows) else []
    along = places[:, np.argmax(np.ptp(places, axis=0))]
    first = np.zeros(len(rows), bool)
    first[np.argsort(along, kind="stable")[: len(rows) // 2]] = True
    return [part for half in (first, ~first) for part in _split(rows[half], places[half])]


def _binned(values, axis, step):
    """Sums of `step` neighbours each along an axis, with zeros beyond its end."""
    if step == 1:
        return values
    values = np.moveaxis(values, axis, 0)
    out = np.zeros((-(-len(values) // step), *values.shape[1:]), values.dtype)
    for k in range(step):
        part = values[k::step]
        out[: len(part)] += part
    return np.moveaxis(out, 0, axis)


def seen_through(sharpness, images, step):
    """T (n, n) times images (m, ny, nx), of n pixels, as rows (m, n); see `_between`."""
    shape = images.shape[1:]
    if shape[0] * shape[1] < MANY_PIXELS and len(images) > 1:
        return images.reshape(len(images), -1) @ _between(sharpness, shape, step)
    from scipy import fft  # takes 0.05 s, not needed by small galaxies

    lags = _lags(sharpness, step)
    far = np.arange(1 - len(lags) // 2, len(lags) // 2)
    far = far[far % step == 0]
    size = [fft.next_fast_len(n + int(far[-1]) // step, real=True) for n in shape]
    around = np.zeros(size, np.float32)
    y, x = (far // step % n for n in size)
    around[y[:, None], x] = lags[far[:, None] % len(lags), far % len(lags)]
    power, out = fft.rfft2(around).real, np.empty_like(images)  # T is symmetric
    for first in range(0, len(images), TOGETHER):
        some = slice(first, first + TOGETHER)
        waves = fft.rfft2(images[some], size) * power
        out[some] = fft.irfft2(waves, size)[:, : shape[0], : shape[1]]
    return out.reshape(len(images), -1)


def _between(sharpness, shape, step):
    """T (n, n) between the n pixels of images of a shape, each a mean over step x step.

    Of those that sharpness (F,) is of, see evidence.LocalPowerSpectra.
    """
    n, lags = N_FREQUENCIES, _lags(sharpness, step)
    far = np.zeros([2 * side - 1 for side in shape], np.float32)
    at = [np.arange(1 - side, side) for side in shape]
    near = [np.flatnonzero(np.abs(a) * step < n // 2) for a in at]
    y, x = (step * a[k] % n for a, k in zip(at, near, strict=True))
    far[near[0][:, None], near[1]] = lags[y[:, None], x]
    size = shape[0] * shape[1]
    return sliding_window_view(far, shape)[::-1, ::-1].reshape(size, size)


def _lags(sharpness, step):
    """T between two means over step x step pixels, by their distance before that.

    (n, n), (0, 0) first.
    """
    n = N_FREQUENCIES
    phase = np.exp(2j * np.pi * np.fft.fftfreq(n)[:, None] * np.arange(step))
    mean = np.abs(phase.mean(1)) ** 2
    power = sharpness.reshape(n, n // 2 + 1) * mean[:, None] * mean[: n // 2 + 1]
    return np.fft.irfft2(power, (n, n))


def _root(curvature, precision):
    """Lower triangular W (m, m) in panels, W^T W the inverse of curvature + precision.

    curvature (m, m), precision (m,). A product of roots is positive definite whatever their
    rounding, so that float32 does: only a matrix that it cannot factor is tried in float64.
    """
    for dtype in (np.float32, np.float64):
        matrix = curvature.astype(dtype)
        matrix[np.diag_indices(len(matrix))] += precision
        potrf, trtri = lapack.get_lapack_funcs(("potrf", "trtri"), (matrix,))
        factor, info = potrf(matrix.T, lower=0, clean=1, overwrite_a=1)
        if not info:
            inverse, info = trtri(factor, lower=0, overwrite_c=1)
        if not info:
            return _panels(inverse.T)
    # lags that T_c leaves out: the diagonal alone
    return _panels(np.diag(1 / np.sqrt(curvature.diagonal() + precision)))


def _panels(root):
    """A lower triangular matrix (m, m), float32, in panels.

    Each PANEL of its rows up to the diagonal of the last one, one after the other, with zeros where
    the matrix has ended.
    """
    m = round_up(len(root), PANEL)
    whole = np.zeros((m, m), np.float32)
    whole[: len(root), : len(root)] = root
    panels = [whole[i : i + PANEL, : i + PANEL].ravel() for i in range(0, m, PANEL)]
    return np.concatenate(panels)
