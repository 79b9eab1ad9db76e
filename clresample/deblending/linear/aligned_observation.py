"""An observation on rows and columns along the model's axes, for the normal matrix.

Errors need only sums of products over the observed pixels. A band-limited image has the same sum of
squares on any pixels of equal density that resolve the band. So an observation that is rotated or
distorted, or has smaller pixels than its band needs, is replaced by one along the model's axes, to
which its weights are resampled. Any other observation is used unchanged. Then images are rendered
from their boxes by a few products with thin matrices, without a full frame, and with the smallest
sufficient band and period.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace

import numpy as np

from ...device.multi_device import host_threads, map_threads
from ...resampling.plan import FAINT
from ...resampling.transfer import transfer_function
from ...sky.psf import PSF, crop_psf
from ..view import WhitenedView
from .mode_images import cell_sums, from_cells

# [FWHM of the observation's PSF] Margin around its box up to which a component's light is rendered.
# Errors of simulated Euclid and Rubin scenes differ by less than 1e-4 from those with 5; with 1, by
# 5e-4.
REACH_FWHM = 1.5
# |D| / max |D| below which a frequency is left out; its information is the square of that. Errors
# of simulated Euclid and Rubin scenes differ by less than 1e-3 from those with a tenth of the
# limit.
BAND = 1e-2
# An observation is replaced by one of the widest pixels that resolve its band if these are wider
# than its own by this factor, which halves their number at least. 99 % of the errors of fluxes and
# moments of simulated scenes change by less than 0.2 %.
MIN_REBIN_FACTOR = 1.2
# Least sum of weights in a cell of several pixels, over the channel's largest: light in such a cell
# counts 1e-5 of that in others.
MIN_CELL_WEIGHT = 1e-10
# Number of frequencies, over channels and images, that are computed at a time, so that they stay in
# a core's second cache. All at once take a quarter more time.
CACHED = 1 << 15
# [px] Periods are a multiple of this plus one, so that similar boxes share a transfer function.
PERIOD_PX = 8
# [px] Period at which the band is determined.
BAND_PERIOD_PX = 65
# Number of cached transfer functions, of 0.3 to 1 MB: those of all observations of a field's tile.
MAX_TRANSFERS = 32
# Number of elements of a component's images, in its box or rendered, from which several host
# threads share the work: 100 modes of a galaxy of 100 pixels a side take 20 ms. When threads also
# shared smaller ones, errors of 300 galaxies of 40 pixels took 4.1 s instead of 2.9 s.
MIN_THREADED_ELEMENTS = 1 << 20


@dataclass(frozen=True, eq=False)
class AlignedObservation:
    """An observation on rows and columns along the model's axes, in units of its noise.

    y (My,), x (Mx,) [model px]: positions of rows and columns, ascending
    sqrt_weights (C, My, Mx): square root of the weights
    reach_px [model px]: see REACH_FWHM; transfer: its BandLimitedTransfer
    coefficients (n, C, T): of its terms in the PSF of each component, None for one term
    n_threads: of the host, for components of MIN_THREADED_ELEMENTS elements
    cell: rows and columns of an image that are one; images, windows and weights are then those of
        cells, images at the cells' middles; `y` and `x` stay
    """

    y: np.ndarray
    x: np.ndarray
    sqrt_weights: np.ndarray
    reach_px: float
    transfer: BandLimitedTransfer
    coefficients: np.ndarray | None
    n_threads: int = 1
    cell: int = 1

    @classmethod
    def of(cls, view: WhitenedView, frame, observation, source):
        """The AlignedObservation of an Observation and its view; source (n,): of each component."""
        scale = np.sqrt(abs(np.linalg.det(view.mapping.matrix)))
        reach = REACH_FWHM * float(observation.psf.fwhm_px.max()) * scale
        matrix = view.mapping.matrix
        psfs = (_PSFKey(psf) for psf in (frame.psf, view.op.plans[0].psfs[1]))
        transfer = _transfer(matrix.tobytes(), *psfs)
        pixel = transfer.nyquist_px
        pixel = pixel if pixel > MIN_REBIN_FACTOR * scale else min(scale, pixel)
        make = _parallel if view.mapping.geometry == "aligned" else _spread
        y, x, root = make(view, pixel)
        shares = None if view.coefficients is None else view.coefficients[source].astype(np.float32)
        return cls(y, x, root, reach, transfer, shares, host_threads(view.op.device))

    def window(self, origin, shape):
        """First and one-past-last row and column (2, 2) within reach of a box of the frame."""
        parts = zip((self.y, self.x), origin, shape, strict=True)
        low, high = np.array(
            [np.searchsorted(at, (o - self.reach_px, o + n - 1 + self.reach_px))
             for at, o, n in parts]
        ).T  # fmt: skip
        return np.array([low // self.cell, -(-high // self.cell)])

    def cell_for(self, pixel):
        """The largest power of 2 of rows and columns that is no wider than `pixel` [model px]."""
        wide = max((at[-1] - at[0]) / max(len(at) - 1, 1) for at in (self.y, self.x))
        return 2 ** max(0, int(np.floor(np.log2(pixel / max(wide, 1e-9)))))

    def in_cells(self, cell):
        """This observation in cells of so many rows and columns, itself of one row each."""
        power = cell_sums(np.square(self.sqrt_weights, dtype=np.float64), cell)
        y, x = (np.pad(at, (0, -len(at) % cell), mode="reflect", reflect_type="odd")
                for at in (self.y, self.x))  # fmt: skip
        # Values interpolated across a mask's edge leave some light in cells without weight, which
        # products count once it has been divided by this root.
        power = np.maximum(power, MIN_CELL_WEIGHT * power.max((1, 2), keepdims=True, initial=0))
        root = np.sqrt(power).astype(np.float32)
        return replace(self, y=y, x=x, sqrt_weights=root, cell=cell)

    def _middles(self, at):
        return at.reshape(-1, self.cell).mean(1)

    def threads_for(self, images):
        """Number of threads for the images of a component."""
        return self.n_threads if images.size > MIN_THREADED_ELEMENTS else 1

    def observe(self, images, i, origin, low, high, pixel=1):
        """Whitened images (C, k, ry, rx) of component i's images (k, ny, nx) in a box.

        The box begins at `origin` of the frame; rows and columns from `low` to `high`; float32, as
        the images are.

        images: see `flush_faint`; pixel [model px]: of the images, see CellImages
        """
        k, m_y, m_x = images.shape
        n_y, n_x = m_y * pixel, m_x * pixel
        nu_y, nu_x, d = self.transfer.at((n_y, n_x), self.reach_px)
        if pixel > 1:  # frequencies that its pixels resolve
            rows, columns = (np.abs(nu) <= 0.5 / pixel for nu in (nu_y, nu_x))
            nu_y, nu_x, d = nu_y[rows], nu_x[columns], d[rows][..., columns]
        if self.coefficients is not None:
            parts = self.coefficients[i]
            d = np.einsum("yctx,ct->ycx", d.reshape(len(nu_y), *parts.shape, -1), parts)
        to_y, to_x = _waves(nu_y, -np.arange(n_y)), _waves(-np.arange(n_x), nu_x)
        if pixel > 1:
            to_y = to_y @ from_cells(n_y, pixel).astype(np.float32)
            to_x = from_cells(n_x, pixel).T.astype(np.float32) @ to_x
        ends = zip(low, high, strict=True)
        rows, columns = (slice(self.cell * a, self.cell * b) for a, b in ends)
        from_y = _waves(self._middles(self.y[rows]) - origin[0], nu_y)
        from_x = _waves(nu_x, self._middles(self.x[columns]) - origin[1])
        to_y = np.concatenate([to_y.real, to_y.imag])
        from_y = np.concatenate([from_y.real, -from_y.imag], axis=1)
        root = self.sqrt_weights[:, low[0] : high[0], low[1] : high[1]]
        out, n = np.empty((len(root), k, *root.shape[1:]), np.float32), max(CACHED // d.size, 1)

        def observe_from(first):
            some = images[first : first + n]
            z = to_y @ some.transpose(1, 0, 2).reshape(m_y, -1)  # (2 Hy, k nx)
            both = np.empty((len(nu_y), z.shape[1]), np.complex64)
            both.real, both.imag = z[: len(nu_y)], z[len(nu_y) :]
            z = both.reshape(-1, m_x) @ to_x
            z = z.reshape(len(nu_y), len(some), 1, -1) * d[:, None]
            z = (z.reshape(-1, len(nu_x)) @ from_x).reshape(len(nu_y), -1)
            seen = from_y @ np.concatenate([z.real, z.imag])
            seen = seen.reshape(len(from_y), len(some), len(root), -1).transpose(2, 1, 0, 3)
            np.multiply(seen, root[:, None], out=out[:, first : first + n])

        map_threads(self.threads_for(images), observe_from, range(0, k, n))
        return out


def align_observations(fit):
    """An AlignedObservation of each observation of a Fit: 1 ms each, 15 ms of 500 x 500 pixels."""
    pairs = zip(fit.views, fit.blend.observations, strict=True)
    return [AlignedObservation.of(view, fit.frame, one, fit.start.source) for view, one in pairs]


class _PSFKey:
    """A PSF that is equal to others of the same samples."""

    def __init__(self, psf):
        self.psf = psf
        self._parts = psf.images.shape, psf.images.tobytes(), psf.center.tobytes(), psf.spacing
        self._hash = hash(self._parts)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self._parts == other._parts


@functools.lru_cache(maxsize=MAX_TRANSFERS)
def _transfer(matrix, psf_in, psf_out):
    """The BandLimitedTransfer of a matrix (as bytes) and two PSFs, shared by equal observations."""
    return BandLimitedTransfer(np.frombuffer(matrix).reshape(2, 2), psf_in.psf, psf_out.psf)


@dataclass(frozen=True, eq=False)
class BandLimitedTransfer:
    """The transfer function of an observation, C T bands, at the frequencies that a box needs.

    matrix (2, 2): of its mapping; psf_in, psf_out: of the model and the observation
    """

    matrix: np.ndarray
    psf_in: PSF
    psf_out: PSF
    _found: dict = field(default_factory=dict)

    @property
    def nyquist_px(self):
        """Pixels [model px] that resolve the band."""
        return 1 / (2 * self._edge.max())

    @functools.cached_property
    def _edge(self):
        """Largest frequencies (2,) along y and x that are needed."""
        # at most the limit of the observation's own pixels
        inside = np.abs(np.linalg.inv(self.matrix).T).sum(1) * 0.5 / self.psf_out.spacing
        nu_y, nu_x, _ = self._band((BAND_PERIOD_PX, BAND_PERIOD_PX), inside)
        # another period may have its last one half a step further
        return np.minimum(inside, np.array([nu_y[-1], nu_x[-1]]) + 0.5 / BAND_PERIOD_PX)

    def at(self, shape, reach):
        """Frequencies nu_y (Hy,) >= 0, nu_x (W,) and D (Hy, C T, W) with the half-plane's weights.

        The period is long enough that a box does not overlap itself within `reach`.
        """
        sides = [int(np.ceil((n + 2 * reach) / PERIOD_PX)) * PERIOD_PX + 1 for n in shape]
        key = tuple(sides)
        if key not in self._found:
            self._found[key] = self._band(key, self._edge)
        return self._found[key]

    @functools.cached_property
    def _lit(self):
        """The parts of both PSFs that matter."""
        return [crop_psf(psf, FAINT * BAND) for psf in (self.psf_in, self.psf_out)]

    def _band(self, period, inside):
        """See `at`; of frequencies `inside` (2,)."""
        nu_y, nu_x = (np.arange(n // 2 + 1) / n for n in period)
        nu_x = np.concatenate([-nu_x[:0:-1], nu_x])
        nu_y, nu_x = nu_y[nu_y <= inside[0]], nu_x[np.abs(nu_x) <= inside[1]]
        psf_in, psf_out = self._lit
        d = transfer_function(psf_in.otf(nu_y, nu_x), psf_out.otf(nu_y, nu_x, self.matrix))[0]
        strong = (np.abs(d) > BAND * np.abs(d).max(axis=(1, 2), keepdims=True)).any(0)
        n_y = int(np.flatnonzero(strong.any(1))[-1]) + 1
        n_x = int(np.abs(np.flatnonzero(strong.any(0)) - len(nu_x) // 2).max())
        d = d[:, :n_y, len(nu_x) // 2 - n_x : len(nu_x) // 2 + n_x + 1].transpose(1, 0, 2)
        d = d * (2 * abs(np.linalg.det(self.matrix)) / (period[0] * period[1]))
        d[0] *= 0.5
        return nu_y[:n_y], np.arange(-n_x, n_x + 1) / period[1], d.astype(np.complex64)


def _waves(a, b):
    """exp(2 pi i a b) for a (n,), b (m,)."""
    return np.exp(2j * np.pi * np.multiply.outer(a, b)).astype(np.complex64)


def _parallel(view, pixel):
    """Rows, columns and root weights of an observation whose axes are the model's.

    If its pixels are smaller than `pixel` [model px], pixels of that side cover the model's frame.
    """
    mapping, root = view.mapping, view.sqrt_weights
    if mapping.matrix[0, 0] == 0:
        root = root.swapaxes(1, 2)
    steps = mapping.matrix.sum(1)
    at = [
        step * np.arange(n) + offset + shift
        for step, n, offset, shift in zip(
            steps, root.shape[1:], mapping.offset, view.op.shift, strict=True
        )
    ]
    if pixel > np.abs(steps).max():
        grid = [_lattice(n, pixel) for n in mapping.shape_in]
        # fractions of each row and column that go to its neighbours on the lattice
        to_y, to_x = (
            np.maximum(1 - np.abs(to[:, None] - own) / pixel, 0)
            for to, own in zip(grid, at, strict=True)
        )
        count = np.outer(to_y.sum(1), to_x.sum(1))
        power = to_y @ root.astype(np.float64) ** 2 @ to_x.T
        return *grid, _mean_root(power, count, pixel**2 / abs(np.prod(steps)))
    root = root[:, :: 1 if steps[0] > 0 else -1, :: 1 if steps[1] > 0 else -1]
    return np.sort(at[0]), np.sort(at[1]), np.ascontiguousarray(root, np.float32)


def _lattice(n, pixel):
    """Pixels of a side `pixel` over n of the frame, one before them and one after them."""
    return (np.arange(int(np.ceil(n / pixel)) + 2) - 1.0) * pixel


def _mean_root(power, count, density):
    """Root weights (C, n_y, n_x) of pixels with the weights `power` of `count` others.

    power (C, n_y, n_x); count (n_y, n_x); `density`: mean of count, used to remove the moire
    pattern of the two grids.
    """
    mean = power / np.maximum(count, 1e-9) * density
    return np.sqrt(np.where(count > 0.5 * density, mean, 0)).astype(np.float32)


def _spread(view, pixel):
    """The same of any other, on pixels of a side `pixel` [model px] over the model's frame."""
    mapping = view.mapping
    y, x = (_lattice(n, pixel) for n in mapping.shape_in)
    at = mapping.at(*np.indices(mapping.shape_out)) + view.op.shift
    good = view.covered & (np.abs(at).max(2) < 2 * max(mapping.shape_in))
    place = (at[good] / pixel).T + 1  # the first row lies a pixel before the frame
    low = np.clip(np.floor(place).astype(int), 0, [[len(y) - 2], [len(x) - 2]])
    part = np.clip(place - low, 0, 1)
    flat = (low[0] * len(x) + low[1] + np.array([[0], [1], [len(x)], [len(x) + 1]])).ravel()
    rows, columns = (np.stack([1 - p, p]) for p in part)
    share = (rows[:, None] * columns).reshape(4, -1)  # of a pixel, in the four about it

    def deposit(values):
        found = np.bincount(flat, (share * values).ravel(), len(y) * len(x))
        return found.reshape(len(y), len(x))

    area = 1.0 if mapping.area is None else np.maximum(mapping.area[good], 1e-6)
    power = np.array([deposit(channel[good] ** 2 / area) for channel in view.sqrt_weights])
    density = pixel**2 / abs(np.linalg.det(mapping.matrix))
    return y, x, _mean_root(power, deposit(1.0), density)
