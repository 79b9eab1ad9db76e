"""Writes and reads the posterior of a fit: modes of morphologies, factor of the matrix."""

from __future__ import annotations

import numpy as np
from astropy.io import fits
from astropy.table import Table

from ..deblending.linear.block_matrix import BlockCholesky
from ..deblending.linear.mode_images import CellImages, ModeImages
from ..deblending.linear.ties import Ties
from ..deblending.posterior.errors import FluxChanges, PosteriorSampler
from .array_hdus import array_of, image_hdu

NODES = ("n_modes", "size", "order", "n_later", "n_smooth", "pixel", "n_smooth_2", "pixel_2")


def draw_hdus(draws):
    """HDUs of a PosteriorSampler; an empty list for None.

    DRAWNODES: a row for each node of the matrix: its modes, unknowns, position in the elimination
    order, and number of neighbours that are eliminated later; how many of the modes are smooth, and
    their pixels, of up to two widths, see ModeImages. DRAWLATER: these neighbours.
    DRAWMODES, DRAWSCALE, DRAWFACTOR: all arrays, concatenated, smooth modes first; the factor
    consists of each node's diagonal block and the block below it, in elimination order. DRAWSUMS,
    DRAWUNIT, DRAWWIDE, DRAWBANDS: see PosteriorSampler. DRAWPAIRS, DRAWLIGHT: source and change,
    and light, of its FluxChanges.
    """
    if draws is None:
        return []
    factor = draws.factor
    n_nodes = len(factor.sizes)
    counts = [len(images) for images in draws.modes] + [0] * (n_nodes - len(draws.modes))
    rows = np.zeros((n_nodes, len(NODES)), np.int64)
    n_later = [len(nodes) for nodes in factor.later]
    rows[:, :4] = np.column_stack([counts, factor.sizes, factor.order, n_later])
    arrays = []
    for row, images in zip(rows, draws.modes, strict=False):
        if isinstance(images, ModeImages):
            for k, part in enumerate(images.smooth):
                row[4 + 2 * k : 6 + 2 * k] = len(part), part.pixel
            arrays += [*(part.values for part in images.smooth), images.sharp]
        else:
            arrays.append(images)
    later = [node for nodes in factor.later for node in nodes]
    bands = () if draws.ties is None else draws.ties.bands
    changes = draws.flux_changes
    none = changes is None
    pairs = np.zeros((2, 0), int) if none else np.array([changes.source, changes.change])
    light = np.zeros((0, len(draws.unit))) if none else changes.by
    return [
        fits.BinTableHDU(Table(rows, names=NODES), name="DRAWNODES"),
        image_hdu("DRAWLATER", np.array(later, np.int64)),
        image_hdu("DRAWMODES", _flat(arrays, np.float32)),
        image_hdu("DRAWSUMS", _flat(draws.sums, np.float64)),
        image_hdu("DRAWSCALE", _flat(factor.scale, np.float64)),
        image_hdu("DRAWFACTOR", _flat(factor.blocks(), np.float64)),
        image_hdu("DRAWUNIT", draws.unit),
        image_hdu("DRAWWIDE", draws.misfit_scale),
        image_hdu("DRAWBANDS", np.array(bands, np.int64)),
        image_hdu("DRAWPAIRS", pairs.astype(np.int64)),
        image_hdu("DRAWLIGHT", light),
    ]


def read_draws(hdus, shapes):
    """Reads the PosteriorSampler of `draw_hdus`, bit by bit; None if there is none.

    shapes (n): (ny, nx) [px] of each component's box
    """
    if "DRAWNODES" not in hdus:
        return None
    table = hdus["DRAWNODES"].data
    counts, sizes, order, n_later, *smooth = (table[name].astype(np.int64) for name in NODES)
    ends = np.cumsum(n_later)[:-1]
    later = [part.tolist() for part in np.split(array_of(hdus["DRAWLATER"]), ends)]
    modes = _ArrayReader(array_of(hdus["DRAWMODES"]))
    names = "DRAWSUMS", "DRAWSCALE", "DRAWFACTOR"
    sums, scale, factor = (_ArrayReader(array_of(hdus[name])) for name in names)
    lower, below = {}, {}
    for v in order.tolist():
        lower[v] = factor.take(sizes[v], sizes[v])
        if later[v]:
            below[v] = factor.take(sum(sizes[u] for u in later[v]), sizes[v])
    bands, pairs, light = (array_of(hdus[f"DRAW{x}"]) for x in ("BANDS", "PAIRS", "LIGHT"))
    return PosteriorSampler(
        [_modes(modes, shape, n, own) for shape, n, *own in zip(shapes, counts, *smooth)],
        [sums.take(1 + count) for _, count in zip(shapes, counts, strict=False)],
        BlockCholesky.restore(
            sizes, [scale.take(n) for n in sizes], order.tolist(), later, lower, below
        ),
        array_of(hdus["DRAWUNIT"]),
        array_of(hdus["DRAWWIDE"]),
        Ties(tuple(bands.tolist())) if len(bands) else None,
        FluxChanges(*pairs, light) if len(light) else None,
    )


def _modes(arrays, shape, count, smooth):
    """The modes of a component from an _ArrayReader, an array or ModeImages.

    smooth: number and pixel of each CellImages, 0 and 0 where there are none
    """
    pairs = [(n, int(pixel)) for n, pixel in zip(smooth[::2], smooth[1::2], strict=True) if pixel]
    cells = [
        CellImages(arrays.take(n, *(-(-side // pixel) for side in shape)), pixel)
        for n, pixel in pairs
    ]
    sharp = arrays.take(count - sum(len(part) for part in cells), *shape)
    return ModeImages(tuple(cells), sharp) if cells else sharp


def _flat(arrays, dtype):
    """Concatenates all values of arrays."""
    return np.concatenate([np.zeros(0, dtype), *(np.ravel(array) for array in arrays)])


class _ArrayReader:
    """Values (N,) from which arrays are read one after the other."""

    def __init__(self, values):
        self.values, self.start = values, 0

    def take(self, *shape):
        """The next array of this shape."""
        begin, self.start = self.start, self.start + int(np.prod(shape))
        return self.values[begin : self.start].reshape(shape).copy()
