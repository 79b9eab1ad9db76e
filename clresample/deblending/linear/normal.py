"""The normal matrix of a scene about its solution: modes, spectra, sky and shifts in one.

Each component's modes are rendered from its box in a window of the observation. Components with
overlapping windows have a common block of the matrix. They are processed in the order of their
rows, and images are dropped once no further window overlaps them: memory is proportional to the
number of overlapping sources, not of all. Smooth modes on wide pixels are rendered on cells of the
observation's pixels, where their products with each other, and with the means of others, are
summed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...device.multi_device import map_threads
from ...sky.box import box_slices
from .block_matrix import BlockMatrix
from .mode_images import interpolation
from .ties import Ties

# [1] Products of this size and more are summed in float64: in float32 their rounding error would
# approach the prior's precision of 1. A source of signal to noise 300 has products of 1e5. With
# 1e6, errors of moments change by up to 3e-3.
LARGE = 3e5
# [model px] Prior scatter of a shift. If the data leave a larger uncertainty, the step goes to 0.
# With a larger value noise would shift observations with hardly any light.
SCATTER_PX = 2.0


@dataclass(frozen=True, eq=False)
class UnknownLayout:
    """Layout of the unknowns: a node for each of n components, and one common to all.

    A component's node holds its modes and then its spectrum (B,); the common one sky levels (C or
    0) and shifts (n_observations - 1, 2) or none, if any.

    n_modes (n,): of the components' modes; n_channels, n_sky, n_shifts
    ties: Ties of the channels, by which B is the number of bands; None: B = C
    """

    n_modes: np.ndarray
    n_channels: int
    n_sky: int = 0
    n_shifts: int = 0
    ties: Ties | None = None

    def band_weights(self, weights):
        """Weights (C,) that count each band once: 0 in all channels but its first; and (B,)."""
        if self.ties is None:
            return weights, weights
        first = self.ties.first
        return np.where(np.isin(np.arange(len(weights)), first), weights, 0), weights[first]

    def by_band(self, slopes):
        """Slopes (B,) by the values of bands, of slopes (C,) by those of channels."""
        return slopes if self.ties is None else self.ties.total(slopes)

    @property
    def n_spectra(self):
        """B."""
        return self.n_channels if self.ties is None else self.ties.n_bands

    def spectra_at(self, channels):
        """Unknowns (Co,) in a spectrum of the channels (Co,) of an observation."""
        return channels if self.ties is None else self.ties.band[channels]

    @property
    def sizes(self):
        """Of the nodes (n or n + 1,)."""
        common = self.n_sky + self.n_shifts
        return np.append(self.n_modes + self.n_spectra, [common] if common else []).astype(int)

    @property
    def common(self):
        """The number of the node of all."""
        return len(self.n_modes)

    def shift(self, o):
        """Unknowns (2,) of observation o's shift in the node of all; None where it has none."""
        if not self.n_shifts or o == 0:
            return None
        return self.n_sky + 2 * (o - 1) + np.arange(2)


def normal_matrix(scene, exposures, images, spectra, layout, smooth=None) -> BlockMatrix:
    """J^T J + prior^-1, where sky levels have the precision of Scene.known_sky.

    scene: Scene; exposures: an AlignedObservation of each observation
    images (n): arrays (1 + k, ny, nx), float32, of morphologies and their modes
    spectra (n, C), in the views' units
    smooth (n): tuples of CellImages of modes that come before those of `images`; none by default
    """
    smooth = [()] * len(images) if smooth is None else smooth
    matrix = BlockMatrix(layout.sizes)
    for i, k in enumerate(layout.n_modes):
        matrix.block(i, i)[:k, :k] += np.eye(k)
    if layout.n_sky:
        at = np.arange(layout.n_sky)
        matrix.block(layout.common, layout.common)[at, at] += scene.known_sky
    if layout.n_shifts:
        at = layout.n_sky + np.arange(layout.n_shifts)
        matrix.block(layout.common, layout.common)[at, at] += SCATTER_PX**-2
    for o, (exposure, part) in enumerate(zip(exposures, scene.channels(), strict=True)):
        sums = _NormalAccumulator(matrix, layout, exposure, o, part)
        sums.run(scene.origin, images, smooth, spectra)
    return matrix


@dataclass(frozen=True, eq=False)
class _ComponentView:
    """Images of one component in an observation.

    i: its index; modes: slice of its node's unknowns, those of the modes here
    low, high (2,): its window
    images (C, u + k or u + k + 2, ry, rx): of its morphology alone, u = 1, or 0 beside smooth
        modes; then, times its spectrum, of its modes, and of its slopes along y and x where a shift
        is unknown
    cell: of pixels in which its images are, see AlignedObservation
    """

    i: int
    modes: slice
    low: np.ndarray
    high: np.ndarray
    images: np.ndarray
    u: int
    cell: int = 1

    @property
    def k(self):
        """Number of modes."""
        return self.modes.stop - self.modes.start

    @cached_property
    def size(self):
        """Largest root of the squares' sum of its images times the spectrum."""
        light = self.images[:, self.u :]
        return np.sqrt(np.einsum("ckyx,ckyx->k", light, light).max(initial=0))

    def within(self, low, high, dtype=np.float32):
        """Images (C, u + k, P) of a type from `low` to `high`."""
        cut = self.images[:, :, *box_slices(low - self.low, high - low)]
        return cut.astype(dtype, copy=False).reshape(*cut.shape[:2], int(np.prod(high - low)))

    def in_cells(self, fine, wide):
        """Images on another lattice with the same products with images that are smooth there.

        fine, wide: the AlignedObservation in its own cells, and in those of the other
        """
        ratio = wide.cell // fine.cell
        low, high = self.low // ratio, -(-self.high // ratio)
        to_y, to_x = (
            interpolation(np.arange(*own), ratio * np.arange(*cells) + (ratio - 1) / 2)
            for own, cells in zip(zip(self.low, self.high), zip(low, high), strict=True)
        )
        to_y, to_x = to_y.T.astype(np.float32), to_x.astype(np.float32)
        root = wide.sqrt_weights[:, None, *box_slices(low, high - low)]
        scale = np.divide(1, root, out=np.zeros_like(root), where=root > 0)
        own = fine.sqrt_weights[:, None, *box_slices(self.low, self.high - self.low)]
        images = to_y @ (self.images * own) @ to_x * scale
        return replace(self, low=low, high=high, images=images, cell=wide.cell)


class _NormalAccumulator:
    """One observation's part of the matrix; channels: slice of all, observation `o`."""

    def __init__(self, matrix, layout, exposure, o, channels):
        self.matrix, self.layout, self.exposure = matrix, layout, exposure
        self.channels, self.shift = channels, layout.shift(o)
        self.lattices = {1: exposure}
        at = layout.spectra_at(np.arange(channels.start, channels.stop))
        self.at = np.unique(at)
        # sums over channels of one band, where the observation has several
        self.sum = None if len(self.at) == len(at) else (at[:, None] == self.at).astype(float)
        if self.sum is None:
            self.at = at

    def run(self, origin, images, smooth, spectra):
        """Adds the observation's products of all pairs of components to the matrix."""
        pairs = zip(origin, images, strict=True)
        windows = [self.exposure.window(at, m.shape[1:]) for at, m in pairs]
        near: list[_ComponentView] = []
        for i in sorted(range(len(images)), key=lambda i: windows[i][0, 0]):
            low, high = windows[i]
            near = [one for one in near if one.cell * one.high[0] > low[0]]
            if not (high > low).all():
                continue
            spectrum = spectra[i, self.channels].astype(np.float32)
            own = [self._seen(i, images[i], spectrum, origin[i], low, high)]
            first = 0
            for part in smooth[i]:
                given = spectrum, origin[i], images[i].shape
                own.append(self._seen_smooth(i, first, part, *given))
                first += len(part)
            for one in own:
                near.append(one)
                both = [(other, one) if other.i <= i else (one, other) for other in near]
                both = [self._on_one_lattice(*pair) for pair in both]
                n_threads = self.exposure.threads_for(one.images)
                products = map_threads(n_threads, lambda pair: _products(*pair), both)
                for pair, found in zip(both, products, strict=True):
                    if found is not None:
                        self._add(*pair, found)
                if self.layout.n_sky:
                    self._add_level(one)
        if self.layout.n_sky:
            at = np.arange(self.channels.start, self.channels.stop)
            common = self.matrix.block(self.layout.common, self.layout.common)
            common[at, at] += np.square(self.exposure.sqrt_weights, dtype=np.float64).sum((1, 2))

    def _seen(self, i, images, spectrum, origin, low, high):
        n_modes = self.layout.n_modes[i]
        modes = slice(n_modes - len(images) + 1, n_modes)
        if self.shift is not None:
            padded = np.pad(images[0], 1, mode="edge")
            images = np.concatenate([images, np.array(np.gradient(padded))[:, 1:-1, 1:-1]])
        seen = self.exposure.observe(images, i, origin, low, high)
        seen[:, 1:] *= spectrum[:, None, None, None]
        return _ComponentView(i, modes, low, high, seen, 1)

    def _seen_smooth(self, i, first, images, spectrum, origin, shape):
        exposure = self._in_cells(self.exposure.cell_for(images.pixel))
        low, high = exposure.window(origin, shape[1:])
        light = exposure.observe(images.values, i, origin, low, high, images.pixel)
        light *= spectrum[:, None, None, None]
        modes = slice(first, first + len(images))
        return _ComponentView(i, modes, low, high, light, 0, exposure.cell)

    def _in_cells(self, cell):
        """The observation in cells, made once."""
        if cell not in self.lattices:
            self.lattices[cell] = self.exposure.in_cells(cell)
        return self.lattices[cell]

    def _on_one_lattice(self, a, b):
        """Two _ComponentViews on the wider one of their lattices."""
        if a.cell == b.cell:
            return a, b
        wide = self._in_cells(max(a.cell, b.cell))
        return tuple(
            one if one.cell == wide.cell else one.in_cells(self._in_cells(one.cell), wide)
            for one in (a, b)
        )

    def _add(self, a, b, found):
        """Adds the products of two components' images, a.i <= b.i, to the matrix; see _products."""
        modes = found[:, a.u :, b.u :].sum(0, dtype=np.float64)
        # of the light of each with the morphology of the other in each channel, if it is there
        by_a, by_b = found[:, : a.u, b.u :].transpose(1, 2, 0), found[:, a.u :, : b.u].T
        units = found[:, : a.u, : b.u].reshape(len(found), a.u * b.u).T
        if self.sum is not None:
            by_a, by_b, units = (part @ self.sum for part in (by_a, by_b, units))
        block = self.matrix.block(a.i, b.i)
        of_a, of_b = (self.layout.n_modes[s.i] + self.at for s in (a, b))
        block[a.modes, b.modes] += modes[: a.k, : b.k]
        for unit in by_b:  # one or none, as below
            block[a.modes, of_b] += unit[: a.k]
        for unit in by_a:
            block[of_a, b.modes] += unit[: b.k].T
        for unit in units:
            block[of_a, of_b] += unit
        if a.i == b.i and a is not b:  # smooth modes of a component, with the rest of it
            block[b.modes, a.modes] += modes[: a.k, : b.k].T
            for unit in by_a:
                block[b.modes, of_a] += unit[: b.k]
        if self.shift is None:
            return
        common, slopes = self.layout.common, modes[a.k :, b.k :]
        if slopes.size:
            both = self.matrix.block(common, common)
            both[np.ix_(self.shift, self.shift)] += slopes if a is b else slopes + slopes.T
        sides = [(a, modes[: a.k, b.k :], of_a, by_a[:, b.k :])]
        if a is not b:
            sides.append((b, modes[a.k :, : b.k].T, of_b, by_b[:, a.k :]))
        for one, rows, at, units in sides:
            if rows.shape[1]:
                side = self.matrix.block(one.i, common)
                side[one.modes, self.shift] += rows
                for unit in units:
                    side[np.ix_(at, self.shift)] += unit.T

    def _add_level(self, one):
        """The products of a component with a level of 1 in each channel."""
        level = self._in_cells(one.cell).sqrt_weights[:, *box_slices(one.low, one.high - one.low)]
        products = one.within(one.low, one.high) @ level.reshape(len(level), -1, 1)
        unit, light = products[:, : one.u, 0].T, products[:, one.u :, 0].T
        at = np.arange(self.channels.start, self.channels.stop)
        side = self.matrix.block(one.i, self.layout.common)
        side[one.modes, at] += light[: one.k]
        for sums in unit:
            side[self.layout.n_modes[one.i] + self.layout.spectra_at(at), at] += sums
        if self.shift is not None and len(light) > one.k:
            both, found = self.matrix.block(*[self.layout.common] * 2), light[one.k :]
            both[np.ix_(self.shift, at)] += found
            both[np.ix_(at, self.shift)] += found.T


def _products(a, b):
    """Products (C, ua + ka, ub + kb) by channel of two _ComponentViews where their windows overlap.

    None without overlap.
    """
    low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
    if not (high > low).all():
        return None
    dtype = np.float64 if a.size * b.size > LARGE else np.float32
    first = a.within(low, high, dtype)
    # NumPy computes half the products if both factors are the same array
    second = first if a is b else b.within(low, high, dtype)
    return first @ second.swapaxes(1, 2)
