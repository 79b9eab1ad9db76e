"""Images of a component's modes, the smooth ones of large galaxies on wide pixels.

The bumps of a galaxy of hundreds of pixels are as wide as tens of them. On pixels of a quarter of
a bump's sigma their images take a tenth of the memory, and so does whatever is computed from them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class CellImages:
    """Smooth images in a box, by their means over cells from the box's first pixel on.

    values (m, my, mx): the means, where images are 0 beyond the box; pixel [px]: side of the cells
    """

    values: np.ndarray
    pixel: int

    def __len__(self):
        return len(self.values)

    def on_pixels(self, values, shape):
        """Images (n, ny, nx) of a shape that have the means (n, my, mx)."""
        to_y, to_x = (from_cells(n, self.pixel).astype(values.dtype) for n in shape)
        return to_y @ (values @ to_x.T)

    def weights(self, images):
        """Weights (r, my, mx) of the means in sums over pixels with images (r, ny, nx)."""
        to_y, to_x = (from_cells(n, self.pixel) for n in images.shape[1:])
        return to_y.T @ images @ to_x


@dataclass(frozen=True, eq=False)
class ModeImages:
    """Images (k, ny, nx) of a component's modes: smooth ones as CellImages, then sharp ones.

    smooth: CellImages, those of one width after the other
    Like an array, it has len and shape, and is converted by np.asarray.
    """

    smooth: tuple[CellImages, ...]
    sharp: np.ndarray

    def __len__(self):
        return self.shape[0]

    @property
    def dtype(self):
        """Of all images."""
        return self.sharp.dtype

    @property
    def shape(self):
        """(k, ny, nx)."""
        return sum(map(len, (*self.smooth, self.sharp))), *self.sharp.shape[1:]

    def __array__(self, dtype=None, copy=None):
        smooth = [part.on_pixels(part.values, self.shape[1:]) for part in self.smooth]
        return np.concatenate([*smooth, self.sharp]).astype(dtype or self.dtype, copy=False)


def cell_sums(values, pixel, *, n_axes=2, beyond="constant"):
    """Sums (..., my, mx) of values (..., ny, nx) over cells of `pixel` [px], see CellImages.

    n_axes: number of last axes that have cells; beyond: mode of np.pad past their ends, by default
        zeros
    """
    if pixel == 1:
        return values
    many, sides = values.shape[:-n_axes], values.shape[-n_axes:]
    short = [(0, 0)] * len(many) + [(0, -n % pixel) for n in sides]
    split = [side for n in sides for side in (-(-n // pixel), pixel)]
    cells = np.pad(values, short, mode=beyond).reshape(*many, *split)
    return cells.sum(tuple(range(-1, -2 * n_axes, -2)))


def sums_with(modes, weights):
    """Sums (r, k) over pixels of modes (k, ny, nx), ModeImages or array, times weights."""
    if isinstance(modes, ModeImages):
        found = [sums_with(part.values, part.weights(weights)) for part in modes.smooth]
        return np.concatenate([*found, sums_with(modes.sharp, weights)], axis=1)
    flat = weights.reshape(len(weights), -1).astype(modes.dtype, copy=False)
    return flat @ modes.reshape(len(modes), flat.shape[1]).T


def subtract(modes, parts, image):
    """Subtracts parts (k,) times an image (ny, nx) from modes, ModeImages or array, in place."""
    if isinstance(modes, ModeImages):
        for cells in modes.smooth:
            m, pixel = len(cells), cells.pixel
            subtract(cells.values, parts[:m], cell_sums(image, pixel) / pixel**2)
            parts = parts[m:]
        modes = modes.sharp
    modes -= parts[:, None, None] * image


def combined(modes, values):
    """Images (..., ny, nx): values (..., k) times modes, ModeImages or an array (k, ny, nx)."""
    if not isinstance(modes, ModeImages):
        return np.tensordot(values, modes, 1)
    many, shape = np.reshape(values, (-1, len(modes))), modes.shape[1:]
    *wide, own = np.split(many, np.cumsum([len(part) for part in modes.smooth]), axis=1)
    found = np.tensordot(own, modes.sharp, 1)
    for part, some in zip(modes.smooth, wide, strict=True):
        found += part.on_pixels(np.tensordot(some, part.values, 1), shape)
    return found.reshape(*np.shape(values)[:-1], *shape)


def from_cells(n, pixel):
    """Shares (n, m) of means over cells of `pixel` pixels in each of n pixels; sums stay."""
    cells = pixel * np.arange(-(-n // pixel) + 1)
    upto = interpolation(np.arange(n + 1), cells)  # of the integral
    return pixel * np.diff(upto, axis=0) @ np.tri(len(cells), len(cells) - 1, -1)


def interpolation(places, nodes):
    """Shares (n, m) of values at equidistant nodes (m,) in those at places (n,), by Lagrange."""
    if len(nodes) == 1:
        return np.ones((len(places), 1))
    at, order = (places - nodes[0]) / (nodes[-1] - nodes[0]) * (len(nodes) - 1), min(4, len(nodes))
    first = np.clip(np.floor(at).astype(int) - order // 2 + 1, 0, len(nodes) - order)
    shares, rows = np.zeros((len(places), len(nodes))), np.arange(len(places))
    for k in range(order):
        others = [j for j in range(order) if j != k]
        factors = [(at - first - j) / (k - j) for j in others]
        shares[rows, first + k] = np.prod(factors, axis=0)
    return shares
