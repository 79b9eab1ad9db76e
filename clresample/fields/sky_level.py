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
# [px] Side of a cell, and the quantile of the cells' levels that is the sky's: the darkest have the
# fewest sources. Errors are 0.00 to 0.02 of a pixel's noise in four fields of `simulate field --sky
# real` and `bright`; with 128 px they are 0.01 to 0.06, as all cells have sources. Without sources
# levels of white noise are 0.025 too low, of noise smoothed by 0.7 px 0.05.
CELL_PX, DARKEST = 64, 0.1
# Largest number of cells that are measured, spread over an image, and the smallest number. The four
# darkest of 16 cells may lie in a large galaxy's wings, and agree: 0.1 to 0.2 of the noise were
# subtracted, and faint galaxies lacked 9 to 50 % of their flux.
MAX_CELLS, MIN_CELLS = 256, 64
# Smallest part of a cell's pixels that must be valid; its level then has an error of 0.04 of their
# noise.
VALID_PART = 0.25
# Quantiles of the cells' levels that must agree, within this part of a pixel's noise or of the
# level. They differ by up to 0.05 of the noise in simulated fields; by 0.1 to 0.4, and by 0.29 of
# the level, in images full of a galaxy, with a gradient, or with dark bowls about galaxies.
AGREEING, ALIKE = (0.05, 0.25), 0.1
# Words of messages of fits, and those where the run has subtracted a level.
OF_RUN = {
    "too much sky was subtracted": "the sky is darker than the level that the run subtracted",
    "sky is left in": "the sky is brighter than the level that the run subtracted",
}
# [1] of a pixel's noise: smaller levels are left.
MIN_LEVEL = 0.05


def find_sky(read, good, shape) -> tuple[float, float] | None:
    """The level of an image's sky [counts], and in units of a pixel's noise; 0 within MIN_LEVEL.

    None where the darkest cells disagree, and of an image of fewer than MIN_CELLS valid cells. A
    level below zero must be that of most cells: sources make others brighter only.

    read: called with a Box, returns its pixels; good: called with a Box, returns its valid pixels
    shape (Ny, Nx) [px]
    """
    edges, found = cell_edges(shape, CELL_PX), []
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
    if brighter - darker > ALIKE * max(sigma, abs(level)):
        return None
    if abs(level) <= MIN_LEVEL * sigma:
        return 0.0, 0.0
    if level < 0 and middle > -MIN_LEVEL * sigma:
        return None
    return float(level), float(level) / sigma


def _spread_cells(counts):
    """Numbers of at most MAX_CELLS cells, evenly spread along each axis of `counts` (2,) cells."""
    most = max(int(MAX_CELLS**0.5), MAX_CELLS // min(counts))
    for n in counts:
        parts = min(n, most)
        yield ((np.arange(parts) + 0.5) * n / parts).astype(int).tolist()


def measured_sky(mosaics, work) -> dict[str, tuple[float, float]]:
    """{channel: (level [counts], in units of a pixel's noise)} of the skies that `find_sky` finds.

    Measured in a run's first start, and read from its folder `work` later, so that all fits have
    the same. That of channels with a background is 0.
    """
    path = work / FILE
    if path.exists():
        return {name: tuple(pair) for name, pair in json.loads(path.read_text()).items()}
    found = {}
    for mosaic in mosaics:
        for c in mosaic.channels:
            bare = c.background is None
            sky = find_sky(c.data.read, c.valid, mosaic.grid.shape) if bare else (0.0, 0.0)
            if sky is not None:
                found[c.name] = sky
    with atomic_file(path) as part:
        part.write_text(json.dumps(found, indent=1))
    return found


def without_sky(mosaics, levels) -> tuple:
    """The mosaics with levels {channel: [counts]} to subtract, where they are not 0."""

    def lowered(c):
        known = c.background is None and levels.get(c.name)
        return replace(c, background=ConstantBackground(levels[c.name])) if known else c

    return tuple(replace(m, channels=tuple(lowered(c) for c in m.channels)) for m in mosaics)


def subtracted_levels(mosaics) -> dict[str, float]:
    """{channel: level [counts]} of what `without_sky` subtracts from mosaics."""
    channels = (c for m in mosaics for c in m.channels)
    return {
        c.name: c.background.level for c in channels if isinstance(c.background, ConstantBackground)
    }


def messages_in_run(messages, mosaics) -> list[str]:
    """Messages of a fit, in which skies of mosaics that a run lowered are about its own level."""
    names = [m.name for m in mosaics if subtracted_levels([m])]
    of_run = {f"{name}: {old}": f"{name}: {new}" for name in names for old, new in OF_RUN.items()}
    return [
        next((new + line[len(old) :] for old, new in of_run.items() if line.startswith(old)), line)
        for line in messages
    ]


def sky_notes(mosaics, found) -> list[str]:
    """A line on each mosaic with a sky that was left in; found: by `measured_sky`."""
    notes = []
    for mosaic in mosaics:
        known = [(c.name, found[c.name][1]) for c in mosaic.channels if c.name in found]
        parts = [f"{name} {part:+.2f}" for name, part in known if part]
        if parts:
            notes.append(
                f"{mosaic.name}: the darkest cells of the sky are at {', '.join(parts)} of a "
                "pixel's noise, which is subtracted; with fit_sky=False it is not"
            )
    return notes
