"""Planes of images in files, read piece by piece, with a cache of decoded rows."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from astropy.io import fits

from ..files.atomic import FileError

# [px] Rows of an entry, in whole tiles: about the side of a small blend's cutout. With fewer rows
# there are more entries; with more, rows are decoded in vain for an isolated cutout.
STRIP_PX = 64
# [bytes] Limit for all strips. A field of 4096 pixels a side, with six bands in pixels twice as
# large and the errors of all, has 350 MB, and the blends of a group lie all over the field. With 64
# MB each blend decoded its rows again: 7.6 GB in all, at 160 MB a second a fifth of a run's time.
MAX_BYTES = 384 << 20
# Largest fraction of a process's memory limit for all strips.
PART = 0.1
# Largest fraction of the cache for the rows of one box; larger ones would displace all others.
LARGEST = 0.25
BYTES = 4  # [bytes] of a pixel, of most images
PLAIN = fits.ImageHDU, fits.PrimaryHDU
SCALES = {"BSCALE", "BZERO", "BLANK"}  # cards of images whose pixels are computed as they are read


class StripCache:
    """Strips of planes, the least recently used dropped beyond `most` bytes. Thread-safe.

    Used only for images whose tiles span their full width, so that any cutout decodes whole rows.
    """

    def __init__(self, most=MAX_BYTES):
        self.most, self.n_bytes = most, 0
        self._kept: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def set_limit(self, bound):
        """Limits the store to a part of this process's memory limit [bytes]; None = any."""
        self.most = MAX_BYTES if bound is None else min(MAX_BYTES, int(PART * bound))

    def clear(self):
        """Drops all rows kept."""
        with self._lock:
            self._kept.clear()
            self.n_bytes = 0

    def read(self, hdu, plane, box) -> np.ndarray | None:
        """The pixels of a Box of an HDU's plane (its number, None where there is one).

        None where strips would not help.
        """
        n_rows = _rows_of(hdu)
        if not n_rows or not box.area:
            return None
        numbers = range(box.y0 // n_rows, (box.y1 - 1) // n_rows + 1)
        if len(numbers) * n_rows * hdu.shape[-1] * BYTES > LARGEST * self.most:
            return None
        with self._lock:
            found = {i: self._kept[key] for i in numbers if (key := (hdu, plane, i)) in self._kept}
            for i in found:
                self._kept.move_to_end((hdu, plane, i))
        missing = [i for i in numbers if i not in found]
        if missing:
            first = missing[0] * n_rows
            rows = slice(first, min((missing[-1] + 1) * n_rows, hdu.shape[-2]))
            index = (rows, slice(None)) if plane is None else (plane, rows, slice(None))
            data = np.asarray(hdu.section[index])
            for i in range(missing[0], missing[-1] + 1):
                at = i * n_rows - first
                found[i] = data[at : at + n_rows].copy()
                self._keep((hdu, plane, i), found[i])
        top = numbers[0] * n_rows
        together = np.concatenate([found[i][:, box.x0 : box.x1] for i in numbers])
        return together[box.y0 - top : box.y1 - top]

    def _keep(self, key, strip):
        with self._lock:
            old = self._kept.pop(key, None)
            self.n_bytes += strip.nbytes - (0 if old is None else old.nbytes)
            self._kept[key] = strip
            while self.n_bytes > self.most:
                self.n_bytes -= self._kept.popitem(last=False)[1].nbytes


def _rows_of(hdu):
    """Rows of a strip of an HDU's images; 0 where its tiles are not as wide as the images."""
    tile = getattr(hdu, "tile_shape", None)
    if tile is None or tile[-1] < hdu.shape[-1]:
        return 0
    return int(tile[-2]) * max(1, STRIP_PX // int(tile[-2]))


STRIPS = StripCache()


def read_section(hdu, plane, box):
    """The pixels of a Box of an HDU's plane, None where it has one.

    Whole rows of an uncompressed image are read and cut: astropy reads them at once, as a view of
    the mapped file, but parts of rows one by one, 40 us each.
    """
    rows, columns = box.slices
    plain = isinstance(hdu, PLAIN) and not isinstance(hdu, fits.CompImageHDU)
    whole = plain and not SCALES.intersection(hdu.header)
    index = (rows, slice(None) if whole else columns)
    data = np.asarray(hdu.section[index if plane is None else (plane, *index)])
    return data[:, columns] if whole else data


@dataclass(frozen=True)
class FilePlane:
    """One plane (Ny, Nx) of an image HDU, plain or tile-compressed, read piece by piece.

    path, hdu: file and number of the HDU; plane: index on the axis that is not on the sky, None
        where the image has two axes
    """

    path: Path
    hdu: int
    plane: int | None = None

    def read(self, box) -> np.ndarray:
        """The pixels of a Box that lies on the image, native. Raises FileError."""
        try:
            hdu = _opened(str(self.path))[self.hdu]
            data = STRIPS.read(hdu, self.plane, box)
            if data is None:
                data = read_section(hdu, self.plane, box)
        except Exception as error:  # a damaged file may provoke any exception in astropy
            reason = " ".join(str(error).split()) or type(error).__name__
            raise FileError(f"{self.path}: HDU {self.hdu} cannot be read ({reason})") from error
        if data.shape != box.shape:
            raise FileError(
                f"{self.path}: HDU {self.hdu} is truncated, {data.shape} pixels of {box.shape}"
            )
        return data.astype(data.dtype.newbyteorder("="), copy=False)


@lru_cache(maxsize=64)
def _opened(path):
    """The HDUs of a file, which stay open: each process maps a file into its memory once.

    With memmap=True astropy would refuse unsigned integers, which masks have.
    """
    return fits.open(path, lazy_load_hdus=True)
