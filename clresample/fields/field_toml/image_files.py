"""The files of one image table: image, weights, masks and noise as planes for its channels."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...files.atomic import FileError
from ...files.fits import (
    band_names,
    celestial_header,
    choose_hdu,
    open_fits,
    read_pixels,
    to_native,
)
from ...sky.correlation import NoiseCorrelation
from ...sky.grid import Grid
from ..mosaic import ArrayPlane, ConstantPlane, FilePlane
from ..readers.band_files import SAME_PX, corner_distance_px
from .headers import mask_value
from .keys import WEIGHTS

# values of `noise` other than the name of a file
NO_FILE = "estimate", "white"


class Images(NamedTuple):
    """All planes of a table's images: of each its plane, header and band's name; on one grid.

    path: of the first file, for messages
    """

    path: Path
    planes: list
    headers: list
    names: list
    grid: Grid


class BandSelection(NamedTuple):
    """Planes of the images in use: `chosen` of those with `names`; shape (Ny, Nx) of each."""

    names: list
    chosen: list
    shape: tuple

    @property
    def n_all(self):
        """Number of the images' planes."""
        return len(self.names)

    def in_cube(self, names):
        """Planes (n,) of a cube with these names that belong to the channels, None if unknown."""
        own = [self.names[i] for i in self.chosen]
        known = len(set(names)) == len(names) > 1 and not any(name.isdigit() for name in own)
        return [names.index(name) for name in own] if known and set(own) <= set(names) else None

    def check_list(self, key):
        """Raises ValueError for a key that lists files or numbers if their order is not clear."""
        if len(self.chosen) == self.n_all and self.chosen != list(range(self.n_all)):
            raise ValueError(
                f"{key} is a list, and bands puts all planes of the images into another order: "
                "leave out bands, and give each list in the order of the images' planes"
            )


class ImageFiles:
    """The files of a table's image, weights, masks and noise.

    folder: that their names are relative to; table: of `parse_scene` or `parse_field`
    inputs: {what: file}, the files are added; in_memory: read all pixels now
    """

    def __init__(self, folder, table, inputs, in_memory):
        self.folder, self.table, self.inputs, self.in_memory = folder, table, inputs, in_memory

    def images(self) -> Images:
        """All planes of the images. Raises FileError where they lie on several grids."""
        files = [self.folder / one for one in as_list(self.table["image"])]
        planes, headers, names = [], [], []
        grid: Grid | None = None
        for k, path in enumerate(files):
            self._note("image", k, len(files), path)
            with open_fits(path) as hdus:
                chosen = choose_hdu(path, hdus, self.table.get("hdu"))
                own, shape = chosen.header.copy(), chosen.shape
                wcs = celestial_header(path, own, hdus)
                axis = _band_axis(path, wcs, chosen)
                sizes = [n for i, n in enumerate(shape) if len(shape) == 2 or i != axis]
                here = _grid(path, wcs, (*sizes,))
                header = hdus[0].header.copy()
                header.extend(own, update=True)  # the primary header completes the HDU's own
                found = self._planes(path, hdus, chosen, axis)
            if grid is None:
                grid = here
            elif here.shape != grid.shape or corner_distance_px(here, grid) > SAME_PX:
                raise FileError(
                    f"{path}: lies on other pixels than {files[0]}: give it a table of its own"
                )
            planes += found
            headers += [header] * len(found)
            names += band_names(own, len(found))
        if len(files) > 1:  # numbers count the planes of all files
            names = [str(i) if name.isdigit() else name for i, name in enumerate(names)]
        assert grid is not None  # image names at least one file
        return Images(files[0], planes, headers, names, grid)

    def weights(self, bands):
        """Planes of weights, variances or RMS, and which of them; None where there are none."""
        kind = next((kind for kind in WEIGHTS if kind in self.table), None)
        for other in WEIGHTS:
            if other != kind and f"{other}_hdu" in self.table:
                hint = "" if kind is None else f": the HDU of {kind} is {kind}_hdu"
                raise ValueError(f"{other}_hdu is given, but {other} names no file{hint}")
        if kind is None:
            return [None] * len(bands.chosen), "weight"
        return [plane for plane, _ in self._of_key(kind, bands)], kind

    def masks(self, bands):
        """Planes of masks, and the bits of each that mean: ignore."""
        none = [None] * len(bands.chosen)
        if "mask" not in self.table:
            for key in ("mask_hdu", "mask_bits"):
                if key in self.table:
                    raise ValueError(f"{key} is given, but mask names no file")
            return none, none
        masks = self._of_key("mask", bands)
        if "mask_bits" not in self.table:
            return [plane for plane, _ in masks], none
        bits = self.table["mask_bits"]
        return [plane for plane, _ in masks], [mask_value(header, bits) for _, header in masks]

    def noise(self, n_channels):
        """The correlations (C,) of the noise that a file holds, one or one for each, or None."""
        value = self.table.get("noise", "white")
        if value in NO_FILE:
            return None
        path = self.folder / value
        self.inputs[f"noise of {self.table['name']}"] = path
        with open_fits(path) as hdus:
            found = to_native(read_pixels(path, choose_hdu(path, hdus, None)))
        try:
            if found.ndim == 2 or len(found) == 1:
                return (NoiseCorrelation(found.reshape(found.shape[-2:])),) * n_channels
            return tuple(NoiseCorrelation(one) for one in found)
        except ValueError as error:
            raise FileError(f"{path}: {error}") from error

    def _of_key(self, key, bands):
        """Planes of the files or numbers of a key, one for each channel, each with its header."""
        given, hdu = as_list(self.table[key]), self.table.get(f"{key}_hdu")
        own = [self.folder / one for one in as_list(self.table["image"])]
        if hdu is not None and not any(isinstance(one, str) for one in given):
            raise ValueError(f"{key}_hdu is given, but {key} names no file")
        found, names = [], []
        for k, one in enumerate(given):
            if not isinstance(one, str):
                found.append((ConstantPlane(float(one)), None))
                continue
            path = self.folder / one
            self._note(key, k, len(given), path)
            if hdu is None and path in own:
                raise ValueError(
                    f"{key} is in the image's own file: {key}_hdu must say which HDU it is"
                )
            with open_fits(path) as hdus:
                chosen = choose_hdu(path, hdus, hdu)
                header, size = chosen.header.copy(), chosen.shape[-2:]
                planes = self._planes(path, hdus, chosen, 0)
                found += [(plane, header) for plane in planes]
                names = band_names(header, len(planes))
            if size != bands.shape:
                raise ValueError(f"{key} has {size} pixels ({path}), the images {bands.shape}")
        if len(given) > 1:
            bands.check_list(key)
        elif (own := bands.in_cube(names)) is not None:
            return [found[i] for i in own]
        return _for_channels(key, found, bands)

    def _planes(self, path, hdus, hdu, axis):
        """The planes of an HDU of two axes, or of three, `axis` being that of the bands."""
        if self.in_memory or axis:
            data = to_native(read_pixels(path, hdu))
            return [ArrayPlane(p) for p in (data[None] if data.ndim == 2 else _first(data, axis))]
        number = hdus.index(hdu)
        return [FilePlane(path, number, i) for i in _indices(hdu.shape)]

    def _note(self, what, k, n, path):
        """Adds a file to the inputs, numbered where there are several."""
        number = f" {k + 1}" if n > 1 else ""
        self.inputs[f"{what}{number} of {self.table['name']}"] = path


def as_list(value) -> list:
    """The value of a key that takes one or a list, as a list."""
    return list(value) if isinstance(value, list) else [value]


def _indices(shape):
    return [None] if len(shape) == 2 else range(shape[0])


def _first(data, axis):
    return np.moveaxis(data, axis, 0)


def _band_axis(path, wcs, hdu):
    """The array axis of the bands. Raises FileError where an axis of the sky is none of the array.

    Array axes count in the opposite order to FITS axes.
    """
    if not wcs.has_celestial:
        raise FileError(f"{path}: HDU {hdu.name} has no celestial WCS")
    rest = sorted({0, 1, 2} - {wcs.wcs.lng, wcs.wcs.lat})
    if len(rest) != 1 or (len(hdu.shape) == 2 and rest != [2]):
        raise FileError(f"{path}: the celestial axes of its WCS are not axes of the image")
    return 2 - rest[0]


def _grid(path, wcs, shape):
    try:
        return Grid.from_wcs(wcs, shape)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error


def _for_channels(key, found, bands):
    """Planes of the channels: one for all, one for each, or those of the bands taken."""
    n = len(bands.chosen)
    if len(found) == 1:
        return found * n
    if len(found) == bands.n_all:
        return [found[i] for i in bands.chosen]
    if len(found) != n:
        raise ValueError(
            f"{key} has {len(found)} planes, the images {bands.n_all}, of which {n} are taken: "
            "give one, or one for each"
        )
    return found
