"""PNG images of whole numbers, so that a page can hold them without another package."""

from __future__ import annotations

import struct
import zlib

import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, COLOUR, PALETTE = 0, 2, 3  # colour types of PNG
# Of zlib: noise does not get smaller with more, and 9 takes four times as long.
EFFORT = 6


def png(image, palette=None, *, smooth=False) -> bytes:
    """An image as the bytes of a PNG, its first row on top.

    image uint8: (Ny, Nx) grey, or numbers of a palette; (Ny, Nx, 3) red, green, blue
    palette (K, 3) uint8: colours
    smooth: whether neighbouring rows are alike; then their differences are stored, which are small
    """
    image = np.ascontiguousarray(image, np.uint8)
    kind = COLOUR if image.ndim == 3 else GREY if palette is None else PALETTE
    n_y, n_x = image.shape[:2]
    rows = image.reshape(n_y, -1)
    if smooth:
        rows = rows - np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.hstack([np.full((n_y, 1), 2 if smooth else 0, np.uint8), rows])
    chunks = [_chunk(b"IHDR", struct.pack(">IIBBBBB", n_x, n_y, 8, kind, 0, 0, 0))]
    if palette is not None:
        chunks.append(_chunk(b"PLTE", np.ascontiguousarray(palette, np.uint8).tobytes()))
    chunks += [_chunk(b"IDAT", zlib.compress(filtered.tobytes(), EFFORT)), _chunk(b"IEND", b"")]
    return SIGNATURE + b"".join(chunks)


def _chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
