"""A check of compressed images before astropy decompresses them."""

from __future__ import annotations

import itertools

import numpy as np
from astropy.io import fits

from .atomic import FileError

# HCOMPRESS_1: a tile begins with two bytes of its own and its sizes, two big-endian int32.
SIZES = slice(2, 10)


def check_tiles(path, hdu):
    """Raises FileError if an HCOMPRESS tile has another size than in its header.

    astropy (up to 8.0 at least) allocates memory by the header and writes by the tile's own size,
    beyond the end of that memory: tools/astropy_hcompress.md is a report of it for astropy.
    """
    if not isinstance(hdu, fits.CompImageHDU) or hdu.compression_type != "HCOMPRESS_1":
        return
    place = hdu.fileinfo()["hdrLoc"]
    with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
        table = next(one for one in hdus if one.fileinfo()["hdrLoc"] == place)
        sizes = _tile_sizes(table.header)
        tiles = table.data["COMPRESSED_DATA"]
        for i, (tile, size) in enumerate(zip(tiles, sizes, strict=False)):
            held = np.asarray(tile).astype(np.uint8).tobytes()[SIZES]
            if held and np.frombuffer(held.ljust(8, b"\0"), ">i4").astype(np.int64).prod() != size:
                raise FileError(
                    f"{path}: HDU {hdu.name} is damaged: tile {i} is not of the {size} pixels that "
                    "its header says"
                )


def _tile_sizes(header):
    """Pixels of each tile, in the order of the table's rows: those at the ends are smaller."""
    axes = []
    for i in range(header["ZNAXIS"], 0, -1):
        n = header[f"ZNAXIS{i}"]
        tile = max(1, header.get(f"ZTILE{i}", n if i == 1 else 1))
        axes.append([min(tile, n - first) for first in range(0, n, tile)])
    return (int(np.prod(sizes)) for sizes in itertools.product(*axes))
