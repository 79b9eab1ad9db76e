"""The part of the sky whose sources a field's catalogue has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..sky.box import Box

AREAS = "auto", "all", "finest"
# Largest area "auto", in that of the mosaic with the smallest pixels: others may be twice as wide,
# however they are turned. The search takes time and disk in proportion; a ground-based image around
# a cutout of a space telescope has hundreds.
MAX_GROWTH = 8
N_SAMPLES = 33  # pixels along each axis of a mosaic that are placed
PLACED_PX = 0.1  # [px] largest error of a pixel that is placed there and back


class FieldArea(NamedTuple):
    """The area of a field in the model's pixels.

    The first model pixel is that of the mosaic with the smallest ones, so that rows and columns
    are negative above and left of it.

    wanted: Box whose sources enter the catalogue; searchable: Box that contains the pixels of all
        mosaics
    notes: messages for the user, a line each
    """

    wanted: Box
    searchable: Box
    notes: tuple[str, ...]


def field_area(mosaics, reference, area, positions=None) -> FieldArea:
    """The FieldArea of mosaics for one of AREAS.

    reference: Grid of the model's pixels; positions (S, 2) [model px]: known sources, or None
    Pixels that the reference's WCS does not place, there and back, are not searchable.
    """
    finest = Box.of(reference.shape)
    placed = {mosaic.name: _placed_pixels(mosaic.grid, reference) for mosaic in mosaics}
    searchable = finest
    for at in placed.values():
        if (known := np.isfinite(at).all(axis=-1)).any():
            searchable = searchable.union(Box.around(at[known]))
    whole = area == "all" or (area == "auto" and searchable.area <= MAX_GROWTH * finest.area)
    wanted = searchable if whole else finest
    left = {name: 1 - wanted.contains(at).mean() for name, at in placed.items()}
    shares = ", ".join(f"{_percent(part)} of {name}" for name, part in left.items() if part)
    notes = []
    if shares:
        growth = searchable.area / finest.area
        remedy = (
            "the WCS of the mosaic with the smallest pixels cannot be continued so far: cut the "
            "other mosaics to the sky around it"
            if whole
            else 'the area is that of the mosaic with the smallest pixels: area = "all" in [field] '
            f"adds the rest, with {growth:.3g} times as many model pixels"
        )
        notes.append(f"part of the sky is not searched ({shares}); {remedy}")
    if positions is not None and (n_out := np.sum(~wanted.contains(positions))):
        notes.append(
            "sources of the list outside the field's area are not in the catalogue "
            f"({n_out} of {len(positions)})"
        )
    return FieldArea(wanted, searchable, tuple(notes))


def check_listed(positions, reference, wanted):
    """Raises ValueError if no position (S, 2) [deg, or arcsec on a flat sky] lies in `wanted`.

    The message has the remedy where swapped positions, or 15 times the first numbers, lie there.
    """
    positions = np.asarray(positions, float)

    def inside(some):
        return wanted.contains(reference.pixel(*some.T)).any()

    if inside(positions):
        return
    names = "(y, x) [arcsec]" if reference.is_flat else "(longitude, latitude) [deg]"
    middle = reference.sky((wanted.y0 + wanted.y1) / 2, (wanted.x0 + wanted.x1) / 2)
    remedy = f"give {names} of sources there"
    if inside(positions[:, ::-1]):
        remedy = "swap the two"
    elif not reference.is_flat and inside(positions * [15, 1]):
        remedy = "multiply right ascensions in hours by 15"
    raise ValueError(
        f"positions are all outside the field's area ({len(positions)} sources, the first at "
        f"({positions[0, 0]:.6g}, {positions[0, 1]:.6g})), must be {names} and be near "
        f"({middle[0]:.6g}, {middle[1]:.6g}): {remedy}"
    )


def _placed_pixels(grid, reference):
    """Positions (n, 2) [model px] of pixels all over a grid; NaN where they are not reversible."""
    y, x = (np.linspace(0, n - 1, N_SAMPLES) for n in grid.shape)
    pixels = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    at = grid.positions_in(reference, *pixels.T)
    back = reference.positions_in(grid, *at.T)
    at[~(np.abs(back - pixels).max(axis=-1) <= PLACED_PX)] = np.nan
    return at


def _percent(part):
    """A share of a mosaic in percent, never 0 or 100 by rounding."""
    return "all" if part == 1 else f"{min(max(100 * part, 1), 99):.0f} %"
