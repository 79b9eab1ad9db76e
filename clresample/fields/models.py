"""The models of all sources in one file, from which those of one blend are read alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits
from astropy.table import Table

from ..files.atomic import FileError, atomic_file
from ..files.fits import open_fits
from .execution.group_results import COMPONENT_COLUMNS

FORMAT = 1  # of the file; raised when an older reader would misread it


@dataclass(frozen=True, eq=False)
class ComponentModel:
    """One component of a source's model.

    id, parent_id: as in the catalogue; origin (2,) [px]: (y, x) of its first pixel in the field's
        model pixels
    morphology (ny, nx) [1]: its image under the model's PSF, with maximum 1
    spectrum (C,) [counts]: flux per model pixel where the morphology is 1; NaN in channels that do
        not cover it
    """

    id: int
    parent_id: int
    origin: tuple[int, int]
    morphology: np.ndarray
    spectrum: np.ndarray


def write_models(path, job, parts, last, ids):
    """Writes the models of the sources with these ids, sorted by their blends.

    HDUs: COMPONENTS, a row for each with COMPONENT_COLUMNS, offset being its first pixel in
    MORPHOLOGIES, and the spectrum; MORPHOLOGIES, one float32 array of all pixels; OFFSETS, rows of
    GroupResults.offsets, empty where no shift and no sky was fitted.
    """
    rows, spectra, flat, offsets = [], [], [], []
    for i, part in enumerate(parts):
        table, pixels, their, moved = part.read("COMPONENTS", "MORPHOLOGIES", "SPECTRA", "OFFSETS")
        offsets += [row for row in moved if last.get(int(row[0])) == i]
        numbers = np.stack([table[name] for name in COMPONENT_COLUMNS], axis=1).tolist()
        for row, spectrum in zip(numbers, their, strict=True):
            source, _, patch, *_, n_y, n_x, start = row
            if last.get(patch) == i and source in ids:
                rows.append(row)
                spectra.append(spectrum)
                flat.append(pixels[start : start + n_y * n_x])
    order = sorted(range(len(rows)), key=lambda k: (rows[k][1], rows[k][0], k))
    table = np.array([rows[k] for k in order], np.int64).reshape(-1, len(COMPONENT_COLUMNS))
    sizes = table[:, 5] * table[:, 6]
    table[:, 7] = np.cumsum(sizes) - sizes
    columns = Table(table, names=COMPONENT_COLUMNS)
    columns["spectrum"] = np.array([spectra[k] for k in order]).reshape(
        len(order), len(job.channels)
    )
    primary, hdu = fits.PrimaryHDU(), fits.table_to_hdu(columns)
    primary.header["CLFORMAT"] = (FORMAT, "of this file")
    for i, name in enumerate(job.channels):
        primary.header[f"BAND{i + 1}"] = (name, f"spectrum {i + 1}")
    hdu.name = "COMPONENTS"
    image = fits.ImageHDU(np.concatenate([flat[k] for k in order]) if order else None)
    image.name = "MORPHOLOGIES"
    known = set(table[:, COMPONENT_COLUMNS.index("fit_id")].tolist())
    offsets = [row for row in offsets if int(row[0]) in known]
    moved = fits.ImageHDU(np.array(sorted(offsets, key=lambda row: row[0])) if offsets else None)
    moved.name = "OFFSETS"
    with atomic_file(path) as part:
        fits.HDUList([primary, hdu, image, moved]).writeto(part, overwrite=True)
    return path


class ModelFile:
    """The models of a field, opened: tables in memory, pixels read when used.

    path: of models.fits
    table: COMPONENT_COLUMNS {name: (n,) int64} of all components; spectra (n, C) [counts]
    channels (C,): names
    low, high (n, 2) [px]: first and one-past-last pixels of their boxes in the field's model pixels

    Raises FileError for a file without models, or of a later format.
    """

    def __init__(self, path):
        with open_fits(path) as hdus:
            if "COMPONENTS" not in hdus or "CLFORMAT" not in hdus[0].header:
                raise FileError(f"{path}: holds no models of a field")
            header = hdus[0].header
            if header["CLFORMAT"] > FORMAT:
                raise FileError(
                    f"{path}: has format {header['CLFORMAT']}, this version reads {FORMAT}"
                )
            rows = hdus["COMPONENTS"].data
            self.table = {name: np.array(rows[name], np.int64) for name in COMPONENT_COLUMNS}
            self.spectra = np.array(rows["spectrum"], float).reshape(len(rows), -1)
            pixels, offsets = hdus["MORPHOLOGIES"], None
            self._start, self._size = pixels.fileinfo()["datLoc"], pixels.header.get("NAXIS1", 0)
            if "OFFSETS" in hdus and hdus["OFFSETS"].data is not None:
                offsets = np.array(hdus["OFFSETS"].data, float)
        self.path = path
        names = [header.get(f"BAND{i + 1}") for i in range(self.spectra.shape[1])]
        self.channels = tuple(names)
        self.low = np.stack([self.table["y0"], self.table["x0"]], axis=1)
        self.high = self.low + np.stack([self.table["n_y"], self.table["n_x"]], axis=1)
        self._offsets = {} if offsets is None else {int(row[0]): row[1:] for row in offsets}

    @cached_property
    def _pixels(self):
        """MORPHOLOGIES, mapped."""
        if not self._size:
            return np.zeros(0, ">f4")
        return np.memmap(self.path, ">f4", "r", self._start, (self._size,))

    def morphology(self, i) -> np.ndarray:
        """Component i's image (ny, nx) [1], float32."""
        start, shape = self.table["offset"][i], tuple(self.high[i] - self.low[i])
        end = start + shape[0] * shape[1]
        return np.array(self._pixels[start:end], np.float32).reshape(shape)

    def shift(self, i, i_mosaic) -> tuple[float, float]:
        """(y, x) [model px] by which a mosaic's pixels were moved in the fit of component i."""
        row = self._offsets.get(int(self.table["fit_id"][i]))
        return (0.0, 0.0) if row is None else tuple(row[2 * i_mosaic : 2 * i_mosaic + 2].tolist())

    def sky(self, i) -> np.ndarray:
        """Sky levels (C,) [counts] of all channels, as fitted with component i."""
        n_channels, row = len(self.channels), self._offsets.get(int(self.table["fit_id"][i]))
        return np.zeros(n_channels) if row is None else row[-n_channels:]

    def model(self, i) -> ComponentModel:
        """Component i."""
        table = self.table
        return ComponentModel(
            int(table["id"][i]),
            int(table["parent_id"][i]),
            (int(table["y0"][i]), int(table["x0"][i])),
            self.morphology(i),
            self.spectra[i],
        )


def read_models(path, parent_id=None) -> list[ComponentModel]:
    """Reads the models of one blend, or of all, and no other pixels.

    path: of the file of models; parent_id: of the blend, None = all blends
    Raises FileError for a file without models, or without this blend.
    """
    file = ModelFile(path)
    chosen = np.arange(len(file.spectra))
    if parent_id is not None:
        chosen = np.flatnonzero(file.table["parent_id"] == parent_id)
        if not len(chosen):
            raise FileError(f"{path}: no blend has the parent_id {parent_id}")
    return [file.model(i) for i in chosen]
