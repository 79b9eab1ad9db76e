"""What a group of fits leaves on disk: one FITS file, whole or absent."""

from __future__ import annotations

from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table, vstack

from ...files.fits import open_fits
from ..box import Box

PATCH_COLUMNS = {
    "patch": np.int64,
    "parent_id": np.int64,
    "round": np.int64,
    "status": "U200",
    "n_sources": np.int64,
    "n_pixels": np.int64,
    "iterations": np.int64,
    "seconds": float,
}
COMPONENT_COLUMNS = ("id", "parent_id", "patch", "y0", "x0", "n_y", "n_x", "offset")
MODEL_COLUMNS = ("patch", "mosaic", "y0", "x0", "y1", "x1", "offset")


@dataclass(eq=False)
class Part:
    """The results of a group of patches.

    rows: QTables of sources, one for each patch; patches: rows of PATCH_COLUMNS
    components: rows of COMPONENT_COLUMNS, offsets counted in `flat`; spectra: (C,) of each
    flat: morphologies, flattened; models: rows of MODEL_COLUMNS, pixels: of these, flattened
    """

    rows: list = field(default_factory=list)
    patches: list = field(default_factory=list)
    components: list = field(default_factory=list)
    spectra: list = field(default_factory=list)
    flat: list = field(default_factory=list)
    models: list = field(default_factory=list)
    pixels: list = field(default_factory=list)
    n_flat: int = 0
    n_pixels: int = 0

    def add_component(self, source_id, patch, origin, morphology, spectrum):
        """A component of a source: its box begins at `origin` (2,) of the field's model pixels."""
        where = (source_id, patch.parent, patch.number, *origin, *morphology.shape, self.n_flat)
        self.components.append(tuple(map(int, where)))
        self.spectra.append(spectrum)
        self.flat.append(np.ravel(morphology).astype(np.float32))
        self.n_flat += morphology.size

    def add_model(self, patch, i_mosaic, box, model):
        """All sources of a patch (C, Ny, Nx) [counts] as a mosaic sees them on a Box."""
        self.models.append((patch.number, i_mosaic, *box, self.n_pixels))
        self.pixels.append(np.ravel(model).astype(np.float32))
        self.n_pixels += model.size

    def to_bytes(self) -> bytes:
        """The file that PartFile reads."""
        hdus = [
            fits.PrimaryHDU(),
            _table(_stacked(self.rows), "CATALOGUE"),
            _table(
                Table(
                    rows=self.patches, names=list(PATCH_COLUMNS), dtype=list(PATCH_COLUMNS.values())
                ),
                "PATCHES",
            ),
            _table(_whole(self.components, COMPONENT_COLUMNS), "COMPONENTS"),
            _floats(self.spectra, "SPECTRA"),
            _floats(self.flat and np.concatenate(self.flat), "MORPHOLOGIES"),
            _table(_whole(self.models, MODEL_COLUMNS), "MODELS"),
            _floats(self.pixels and np.concatenate(self.pixels), "PIXELS"),
        ]
        file = BytesIO()
        fits.HDUList(hdus).writeto(file)
        return file.getvalue()


def _stacked(tables):
    tables = [table for table in tables if len(table)]
    return vstack(tables, join_type="outer", metadata_conflicts="silent") if tables else QTable()


def _whole(rows, names):
    return Table(np.array(rows, np.int64).reshape(-1, len(names)), names=names)


def _table(table, name):
    hdu = fits.table_to_hdu(table) if table.colnames else fits.BinTableHDU()
    hdu.name = name
    return hdu


def _floats(array, name):
    array = np.asarray(array)
    return fits.ImageHDU(array if array.size else None, name=name)


@dataclass(frozen=True)
class PartFile:
    """A part on disk."""

    path: Path

    def table(self, name) -> QTable:
        """The table of an HDU."""
        with open_fits(self.path) as hdus:
            hdu = hdus[name]
            return QTable.read(hdu) if hdu.columns.names else QTable()

    def array(self, name) -> np.ndarray:
        """The pixels of an HDU, native; empty where it has none."""
        with open_fits(self.path) as hdus:
            data = hdus[name].data
            if data is None:
                return np.zeros(0, np.float32)
            return np.array(data, dtype=data.dtype.newbyteorder("="))

    def models(self, chosen=None):
        """(patch, mosaic, Box, model (C, Ny, Nx)) of its patches, or of those whose number is in
        `chosen`."""
        index = self.table("MODELS")
        with open_fits(self.path) as hdus:
            hdu = hdus["PIXELS"]
            ends = [*index["offset"][1:], hdu.header.get("NAXIS1", 0)] if len(index) else []
            for row, end in zip(index, ends, strict=True):
                if chosen is None or row["patch"] in chosen:
                    box = Box(*(int(row[k]) for k in ("y0", "x0", "y1", "x1")))
                    image = np.array(hdu.section[int(row["offset"]) : int(end)], np.float32)
                    yield int(row["patch"]), int(row["mosaic"]), box, image.reshape(-1, *box.shape)
