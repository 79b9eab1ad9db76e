"""An instrument's images as tiles at several scales, for mosaics of any size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.box import Box
from .codes import encode
from .colours import Stretch, stretch_of
from .instrument import Instrument

TILE_PX = 256  # side of a tile: smaller ones are more to list, larger ones more to decode at once
LAYERS = "model", "residual"  # the data are their sum
# [bytes] Estimated base64 size of a pixel of both layers in one channel, to choose a first finest
# level; the true size decides.
PIXEL_BYTES = 1.0
CELLS = 96  # of the map of chi2 along the longer side, at most
MIN_CELL_PX = 8  # smaller cells scatter by over 20 % in one channel from the noise alone
# [sigma^2] Largest chi2 of a pixel, so that one cosmic ray or star's core does not dominate a cell.
MAX_CHI2 = 36.0


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Tiles of one instrument.

    instrument; stretch: how its light is shown at first
    finest: level of the finest tiles, 0 = the mosaic's pixels, each level above has pixels twice as
        large
    levels: dicts as the page reads them, the finest first
    n_bytes: of all tiles
    chi2 (My, Mx): mean of (residual / sigma)^2 in cells, NaN where there is no sky; cell_px
    """

    instrument: Instrument
    stretch: Stretch
    finest: int
    levels: list
    n_bytes: int
    chi2: np.ndarray
    cell_px: int


def pyramid_of(instrument, frame, budget) -> Pyramid:
    """Tiles of an instrument within a number of bytes.

    The finest levels are left out until they fit; the coarsest, of one tile, always stays.

    frame: Grid in whose pixels the page shows everything
    """
    shape = instrument.grid.shape
    stretch = stretch_of(instrument.sample, instrument.noise_sigma)
    coarsest = max(0, int(np.ceil(np.log2(max(shape) / TILE_PX))))
    # predictions may be too large by a half, for which no level is left out
    more = max(full_bytes(instrument) / (1.5 * max(budget, 1)), 1)
    finest = int(np.clip(np.ceil(np.log2(more) / 2), 0, coarsest))
    planes, chi2, cell = _read(instrument, finest)
    levels = []
    for level in range(finest, coarsest + 1):
        if level > finest:
            planes = [_halved(plane) for plane in planes]
        levels.append(_tiles(planes, level, instrument, frame))
    sizes = [_size(level) for level in levels]
    while len(levels) > 1 and sum(sizes) > budget:
        levels, sizes, finest = levels[1:], sizes[1:], finest + 1
    return Pyramid(instrument, stretch, finest, levels, sum(sizes), chi2, cell)


def full_bytes(instrument) -> float:
    """[bytes] that an instrument's tiles take if none is left out, about."""
    n_y, n_x = instrument.grid.shape
    return 4 / 3 * n_y * n_x * PIXEL_BYTES * len(instrument.channels)


def _read(instrument, level):
    """[model (C, ny, nx), residual (C, ny, nx)] [counts] of a level, map of chi2, its cells' side.

    Both are NaN where there are no data.
    """
    n_y, n_x = instrument.grid.shape
    step = 2**level
    cell = MIN_CELL_PX
    while max(n_y, n_x) > CELLS * cell:
        cell *= 2
    rows = max(step, cell, TILE_PX)  # of a strip: a multiple of both, all being powers of 2
    sigma = instrument.noise_sigma[:, None, None]
    strips, cells = [], []
    with instrument.opened() as read:
        for y0 in range(0, n_y, rows):
            model, left = read(Box(y0, 0, min(y0 + rows, n_y), n_x))
            left = np.where(instrument.dead(left), np.nan, left)
            model = np.where(np.isfinite(left), model, np.nan)
            strips.append([_averaged(plane, step) for plane in (model, left)])
            squares = np.minimum((left / sigma) ** 2, MAX_CHI2).mean(axis=0, keepdims=True)
            cells.append(_averaged(squares, cell)[0])
    planes = [np.concatenate(few, axis=1) for few in zip(*strips, strict=True)]
    return planes, np.concatenate(cells), cell


def _averaged(planes, step):
    """Means (C, ny, nx) of blocks of step x step pixels that are not NaN; NaN where all are."""
    if step == 1:
        return np.asarray(planes, np.float32)
    good = np.isfinite(planes)
    sums, counts = np.where(good, planes, 0).astype(np.float64), good.astype(np.float64)
    for axis in (1, 2):
        starts = np.arange(0, planes.shape[axis], step)
        sums, counts = (np.add.reduceat(a, starts, axis=axis) for a in (sums, counts))
    means = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    return means.astype(np.float32)


def _halved(planes):
    return _averaged(planes, 2)


def _tiles(planes, level, instrument, frame):
    """A level as the page reads it: {"scale", "places", "origins", and of each layer its tiles}.

    A tile is a list of a text of `codes.encode` for each channel, in units of the noise of a mean
    of 4^level pixels; places are the columns and rows of a tile and six numbers that take its
    pixels (column, row), counted from its first corner, to (x, y) of the frame; origins are its
    first (x, y) in the level.
    """
    found = {"scale": 2**level, "places": [], "origins": []} | {layer: [] for layer in LAYERS}
    n_y, n_x = planes[0].shape[1:]
    units = instrument.noise_sigma / 2.0**level
    for y0 in range(0, n_y, TILE_PX):
        for x0 in range(0, n_x, TILE_PX):
            cut = [plane[:, y0 : y0 + TILE_PX, x0 : x0 + TILE_PX] for plane in planes]
            sides = cut[0].shape[1:]
            place = frame_transform(instrument.grid, frame, (y0, x0), sides, 2**level)
            if place is None:
                continue
            found["places"].append([sides[1], sides[0], *place])
            found["origins"].append([x0, y0])
            for layer, images in zip(LAYERS, cut, strict=True):
                smooth = layer == "model"
                found[layer].append(
                    [encode(i, u, smooth=smooth) for i, u in zip(images, units, strict=True)]
                )
    return found


def frame_transform(grid, frame, corner, shape, scale):
    """Six numbers that take (column, row) in a piece of an image to (x, y) of the frame's pixels.

    grid: Grid of the image; corner (2,), shape (2,): first pixel (y, x) and size of the piece, in
    pixels `scale` times as large as the grid's. (x, y) = (a u + c v + e, b u + d v + f) for the
    column u and row v, 0 at the piece's outer corner; None where it has no place in the frame.
    """
    v, u = np.meshgrid(*(np.linspace(0, n, 3) for n in shape), indexing="ij")
    rows, columns = ((c + w) * scale - 0.5 for c, w in zip(corner, (v, u), strict=True))
    at = grid.positions_in(frame, rows, columns).reshape(-1, 2)
    good = np.isfinite(at).all(axis=1)
    if good.sum() < 4:
        return None
    design = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)[good]
    (ay, by, cy), (ax, bx, cx) = np.linalg.lstsq(design, at[good], rcond=None)[0].T
    return [float(f"{value:.7g}") for value in (ax, ay, bx, by, cx, cy)]


def _size(level):
    return sum(len(text) for layer in LAYERS for tile in level[layer] for text in tile)
