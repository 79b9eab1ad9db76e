"""The level of a mosaic's sky: measured once in a run, stored in its folder, and subtracted."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from ..files.atomic import atomic_file
from ..sky.box import Box
from ..sky.noise import background
from .background import ConstantBackground, cell_edges

FILE = "sky_levels.json"  # in the folder of a run
# Largest number of cells by which the level is measured, spread over an image, and the smallest
# number: images of fewer cells may be full of one galaxy.
MAX_CELLS, MIN_CELLS = 256, 16
# Smallest part of a cell's pixels that must be valid: the error of its level is then 0.02 of a
# pixel's noise.
VALID_PART = 0.25
# The level is the quantile DARKEST of the cells', as the darkest have the fewest sources.
DARKEST = 0.1
# Quantiles of the cells' levels that must agree, within MIN_LEVEL of a pixel's noise or ALIKE of
# the level. They differ by up to 0.06 of the noise in `simulate field`; by 0.1 to 0.4, and 0.29 of
# the level, in images full of a galaxy, with a gradient, or with dark bowls about galaxies.
AGREEING, ALIKE = (0.05, 0.25), 0.1
# [1] of a pixel's noise: smaller levels are left, as faint sources alone have 0.06 in `simulate
# field --sky real` without faults.
MIN_LEVEL = 0.1


def find_sky(read, good, shape) -> tuple[float, float] | None:
    """The level of an image's sky [counts], and in units of a pixel's noise.

    None of a level within MIN_LEVEL, where the darkest cells disagree, and of an image of fewer
    than MIN_CELLS valid cells. A level below zero must be that of most cells: sources make others
    brighter only.

    read: called with a Box, returns its pixels; good: called with a Box, returns its valid pixels
    shape (Ny, Nx) [px]
    """
    edges, found = cell_edges(shape), []
    rows, columns = _spread_cells([len(part) - 1 for part in edges])
    for i in rows:
        for j in columns:
            (y, x), (y1, x1) = ((int(edges[0][i + k]), int(edges[1][j + k])) for k in (0, 1))
            cell = Box(y, x, y1, x1)
            try:
                pixels = read(cell)[good(cell)]
            except (OSError, ValueError):  # the search of its tile gives the reason
                continue
            if np.isfinite(pixels).sum() >= VALID_PART * cell.area:
                found.append(background(pixels))
    levels = np.array([pair for pair in found if pair[1] > 0])  # filled cells have no noise
    if len(levels) < MIN_CELLS:
        return None
    levels, sigma = levels[:, 0], float(np.median(levels[:, 1]))
    level, middle = np.quantile(levels, [DARKEST, 0.5])
    darker, brighter = np.quantile(levels, AGREEING)
    least = MIN_LEVEL * sigma
    agree = brighter - darker < max(least, ALIKE * abs(level))
    if not agree or abs(level) <= least or (level < 0 and middle > -least / 2):
        return None
    return float(level), float(level) / sigma


def _spread_cells(counts):
    """Numbers of at most MAX_CELLS cells, evenly spread along each axis of `counts` (2,) cells."""
    most = max(int(MAX_CELLS**0.5), MAX_CELLS // min(counts))
    for n in counts:
        parts = min(n, most)
        yield ((np.arange(parts) + 0.5) * n / parts).astype(int).tolist()


def measured_sky(mosaics, work) -> dict[str, tuple[float, float]]:
    """{channel: (level [counts], in units of a pixel's noise)} of the skies that were left in.

    Measured in a run's first start, and read from its folder `work` later, so that all fits have
    the same. Channels with a background have none.
    """
    path = work / FILE
    if path.exists():
        return {name: tuple(pair) for name, pair in json.loads(path.read_text()).items()}
    found = {}
    for mosaic in mosaics:
        for c in mosaic.channels:
            if c.background is None:
                sky = find_sky(c.data.read, c.valid, mosaic.grid.shape)
                if sky is not None:
                    found[c.name] = sky
    with atomic_file(path) as part:
        part.write_text(json.dumps(found, indent=1))
    return found


def without_sky(mosaics, levels) -> tuple:
    """The mosaics with levels {channel: [counts]} to subtract."""

    def lowered(c):
        known = c.background is None and c.name in levels
        return replace(c, background=ConstantBackground(levels[c.name])) if known else c

    return tuple(replace(m, channels=tuple(lowered(c) for c in m.channels)) for m in mosaics)


def subtracted_levels(mosaics) -> dict[str, float]:
    """{channel: level [counts]} of what `without_sky` subtracts from mosaics."""
    channels = (c for m in mosaics for c in m.channels)
    return {
        c.name: c.background.level for c in channels if isinstance(c.background, ConstantBackground)
    }


def sky_notes(mosaics, found) -> list[str]:
    """A line on each mosaic with a sky that was left in; found: by `measured_sky`."""
    notes = []
    for mosaic in mosaics:
        parts = [f"{c.name} {found[c.name][1]:+.2f}" for c in mosaic.channels if c.name in found]
        if parts:
            notes.append(
                f"{mosaic.name}: the darkest cells of the sky are at {', '.join(parts)} of a "
                "pixel's noise, which is subtracted; with fit_sky=False it is not"
            )
    return notes
