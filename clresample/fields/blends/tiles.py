"""Divides a field into tiles: the box that is searched, and the core that owns sources."""

from __future__ import annotations

from typing import NamedTuple

from ...sky.box import Box


class SearchTile(NamedTuple):
    """One tile of the model's pixels.

    core: Box whose sources are this tile's; the cores of all tiles fill the field once
    outer: Box that is searched, the core with a margin
    """

    number: int
    core: Box
    outer: Box


def tiles_of(region, size, overlap) -> list[SearchTile]:
    """The tiles of a Box of the model's pixels, row by row, of nearly equal size.

    size [px]: largest side of a core. Larger tiles take more memory: about 100 bytes a pixel and
        channel, for float64 images of all instruments
    overlap [px]: margin of the outer box on each side, cut at the region's edge. It must contain
        a source and its surroundings: an object cut by the outer edge would be split into other
        sources than the whole object

    Raises ValueError for a size that is not positive, or an overlap below 0.
    """
    if not size >= 1 or not overlap >= 0:
        raise ValueError(f"size {size} must be 1 px or more and overlap {overlap} 0 px or more")
    rows, columns = (
        _parts(a, b, size) for a, b in ((region.y0, region.y1), (region.x0, region.x1))
    )
    cores = [Box(y0, x0, y1, x1) for y0, y1 in rows for x0, x1 in columns]
    return [
        SearchTile(i, core, core.grown(overlap).intersection(region))
        for i, core in enumerate(cores)
    ]


def field_part(region, i, n) -> Box:
    """The i-th of n parts (from 1) of a Box, in rows and columns as nearly square as n allows.

    Raises ValueError for an i that is not 1 to n.
    """
    if not 1 <= i <= n:
        raise ValueError(f"part is {i} of {n}, must be 1 to {n} of them")
    n_rows = max(k for k in range(1, n + 1) if n % k == 0 and k * k <= n)
    row, column = divmod(i - 1, n // n_rows)
    y, x = (
        [start + (end - start) * k // parts for k in range(parts + 1)]
        for start, end, parts in (
            (region.y0, region.y1, n_rows),
            (region.x0, region.x1, n // n_rows),
        )
    )
    return Box(y[row], x[column], y[row + 1], x[column + 1])


def _parts(start, end, size):
    """Pairs (start, end) of equal parts of at most `size`, to a pixel."""
    n = -(-(end - start) // size)
    edges = [start + (end - start) * i // n for i in range(n + 1)]
    return list(zip(edges[:-1], edges[1:], strict=True))
