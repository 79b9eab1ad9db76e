"""Pictures of single sources: data, model and residual in every channel."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np

from ...files.whole_file import FileError
from ..box import Box
from .png import png
from .pyramid import as_text, placed
from .shades import EMPTY, KNEE_SIGMAS, NOISY_SHADES, residual_numbers, residual_palette

# [frame px] Half the side of a source's pictures: some sky is seen around the faintest, and the
# largest still fit a page.
LEAST_HALF, MOST_HALF = 18, 64
SIZES = 4.0  # half sides in units of a source's size
MOST_STAMPS = 2000  # sources with pictures, at most: reading them takes some 10 ms each


def stamps_of(run, frame, order, budget, notes):
    """{source's row: its pictures as the page reads them}, of the first rows of `order` that fit
    into `budget` bytes.

    run: Run; frame: Grid of the page's pixels; order: rows of the catalogue, the first ones first

    Of each: "box" [x0, y0, side] of the frame's pixels shown, and "rows", a dict for each channel:
    "name", "sky" and "left" (base64 of PNG: data beside model, and the residual), "size" [columns,
    rows] of one of them, "place" as `pyramid.placed` gives it.
    """
    at = positions(run)
    sizes = _sizes(run, frame)
    found, used = {}, 0
    with ExitStack() as files:
        opened = [(one, files.enter_context(one.opened())) for one in run.instruments]
        for row in list(order)[:MOST_STAMPS]:
            half = int(np.clip(np.ceil(SIZES * sizes[row]), LEAST_HALF, MOST_HALF))
            if not np.isfinite(at[row]).all():
                continue
            y, x = np.rint(at[row]).astype(int).tolist()
            wanted = Box(y - half, x - half, y + half + 1, x + half + 1)
            try:
                rows = [r for one, read in opened for r in _rows(one, read, frame, wanted)]
            except FileError as error:
                notes.append(f"no pictures of some sources: {error}")
                break
            used += sum(len(r["sky"]) + len(r["left"]) for r in rows)
            if used > budget:
                break
            found[int(row)] = {"box": [wanted.x0, wanted.y0, 2 * half + 1], "rows": rows}
    return found


def positions(run):
    """(S, 2) [px]: (y, x) of the sources in the page's frame."""
    if not len(run.sources):
        return np.zeros((0, 2))
    return np.stack([plain(run.sources[c]) for c in ("y", "x")], axis=1) - run.offset


def plain(column):
    """A column's numbers (S,), float64, without their unit."""
    return np.asarray(getattr(column, "value", column), np.float64)


def _sizes(run, frame):
    """(S,) [frame px] sizes of the sources, 0 where unknown."""
    if "size" not in run.sources.colnames:
        return np.zeros(len(run.sources))
    return np.nan_to_num(plain(run.sources["size"])) / frame.pixel_scale_arcsec


def _rows(instrument, read, frame, wanted):
    """The pictures of one instrument's channels; none where it does not hold the place."""
    y0, x0, y1, x1 = np.array(wanted) - 0.5
    corners = frame.positions_in(instrument.grid, [y0, y0, y1, y1], [x0, x1, x0, x1])
    if not np.isfinite(corners).all():
        return
    box = Box.around(corners).meet(Box.of(instrument.grid.shape))
    if not box.area:
        return
    models, left = read(box)
    left = np.where(instrument.dead(left), np.nan, left)
    place = placed(instrument.grid, frame, box[:2], box.shape, 1)
    if place is None:
        return
    for c, name in enumerate(instrument.channels):
        sigma = float(instrument.sigma[c])
        white = max(float(np.nan_to_num(models[c]).max(initial=0)), 8 * KNEE_SIGMAS * sigma)
        pair = [_grey(image, sigma, white) for image in (models[c] + left[c], models[c])]
        yield {
            "name": name,
            "sky": as_text(png(np.hstack(pair))),
            "left": as_text(png(residual_numbers(left[c] / sigma), residual_palette())),
            "size": [box.shape[1], box.shape[0]],
            "place": place,
        }


def _grey(image, sigma, white):
    """Shades (Ny, Nx) uint8 of an image [counts], those of EMPTY for no data."""
    knee = KNEE_SIGMAS * sigma
    level = np.arcsinh((np.nan_to_num(image) + knee) / knee) / np.arcsinh((white + knee) / knee)
    steps = np.rint((NOISY_SHADES - 1) * np.clip(level, 0, 1))
    shades = np.rint(steps * (255 / (NOISY_SHADES - 1))).astype(np.uint8)
    return np.where(np.isfinite(image), shades, np.uint8(EMPTY[1]))
