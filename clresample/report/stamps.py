"""Pictures of single sources: data, model, residual and the source alone in every channel."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np

from ..files.atomic import FileError
from ..sky.box import Box
from .alone import OwnModels
from .codes import encode
from .pyramid import frame_transform

# [frame px] Half the side of a source's pictures, smallest and largest: the faintest have some sky
# around them, and the largest fit on a page.
MIN_HALF, MAX_HALF = 18, 64
SIZES = 4.0  # half sides in units of a source's size
LAYERS = "model", "residual", "own"
MAX_STAMPS = 2000  # sources with pictures, at most: reading them takes some 10 ms each


def stamps_of(run, frame, order, budget, notes):
    """{source's row: its pictures}, of the first rows of `order` that fit into `budget` bytes.

    run: RunFolder; frame: Grid of the page's pixels; order: rows of the catalogue, the first ones
        first

    Of each: "box" [x0, y0, side] of the frame's pixels shown, and "rows", a dict for each channel:
    "name", "instrument" and "channel" (numbers), "model" and "residual" (texts of `codes.encode` in
    units of the channel's noise), "own" (the source's own model, where it can be had), "size"
    [columns, rows], "origin" (x, y) of the first pixel, "place" as `pyramid.frame_transform` gives
    it.
    """
    at = positions(run)
    sizes = _sizes(run, frame)
    found, used, own = {}, 0, OwnModels(run, notes)
    with ExitStack() as files:
        opened = [(one, files.enter_context(one.opened())) for one in run.instruments]
        for row in list(order)[:MAX_STAMPS]:
            half = int(np.clip(np.ceil(SIZES * sizes[row]), MIN_HALF, MAX_HALF))
            if not np.isfinite(at[row]).all():
                continue
            y, x = np.rint(at[row]).astype(int).tolist()
            wanted = Box(y - half, x - half, y + half + 1, x + half + 1)
            try:
                source = int(run.sources["id"][row])
                rows = []
                for k, (one, read) in enumerate(opened):
                    rows += _rows(k, one, read, frame, wanted, own, source)
            except FileError as error:
                notes.append(f"no pictures of some sources: {error}")
                break
            used += sum(len(r[name]) for r in rows for name in LAYERS if name in r)
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
    if "rms_size" not in run.sources.colnames:
        return np.zeros(len(run.sources))
    return np.nan_to_num(plain(run.sources["rms_size"])) / frame.pixel_scale_arcsec


def _rows(number, instrument, read, frame, wanted, own, source):
    """The pictures of one instrument's channels; none where it does not hold the place."""
    y0, x0, y1, x1 = np.array(wanted) - 0.5
    corners = frame.positions_in(instrument.grid, [y0, y0, y1, y1], [x0, x1, x0, x1])
    if not np.isfinite(corners).all():
        return
    box = Box.around(corners).intersection(Box.of(instrument.grid.shape))
    if not box.area:
        return
    models, left = read(box)
    left = np.where(instrument.dead(left), np.nan, left)
    models = np.where(np.isfinite(left), models, np.nan)
    place = frame_transform(instrument.grid, frame, box[:2], box.shape, 1)
    if place is None:
        return
    light = own.on(source, instrument, box)
    for c, name in enumerate(instrument.channels):
        sigma = float(instrument.noise_sigma[c])
        found = {
            "name": name,
            "instrument": number,
            "channel": c,
            "model": encode(models[c], sigma, smooth=True),
            "residual": encode(left[c], sigma),
            "size": [box.shape[1], box.shape[0]],
            "origin": [box.x0, box.y0],
            "place": place,
        }
        if light is not None:
            found["own"] = encode(light[c], sigma, smooth=True)
        yield found
