"""Results of a group of fits on disk: one file of arrays, written atomically."""

from __future__ import annotations

import json
import math
import os
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy import units as u

from ...deblending.linear.equations import N_PARAMETERS
from ...deblending.solver.scene import ComponentStructure
from ...files.atomic import FileError
from ...measurement.columns import DEFINITIONS, Columns, definitions
from ...sky.box import Box

# Columns of patches, also of fit_table.ecsv.
PATCH_COLUMNS = definitions(
    {
        "fit_id": ("number of the fit", None, np.int64),
        "parent_id": ("id of the brightest source detected in the blend", None, np.int64),
        "n_refits": ("last round in which a piece of a cut blend was fitted again", None, np.int64),
        "status": ("how the fit ended", None, "U"),
        "n_sources": ("that were fitted together", None, np.int64),
        "n_pixels": ("of the model, about the blend", None, np.int64),
        "n_iterations": ("of the fit", None, np.int64),
        "seconds": ("of the fit, its share of a group's", u.s),
        "messages": ("problems of the fit, its images and sources, with | between them", None, "U"),
    }
)
SEPARATOR = " | "  # between the messages of a fit
FOUND_COLUMNS = {
    "fit_id": PATCH_COLUMNS["fit_id"],
    **{name: DEFINITIONS[name] for name in ("id", "y", "x")},
    "host": DEFINITIONS["group_id"],
}
COMPONENT_COLUMNS = ("id", "parent_id", "fit_id", "y0", "x0", "n_y", "n_x", "offset")
SCALE_COLUMNS = ("component", "n_y", "n_x", "clear")
MODEL_COLUMNS = ("fit_id", "mosaic", "n_channels", "y0", "x0", "y1", "x1", "offset")


@dataclass(eq=False)
class GroupResults:
    """The results of a group of patches.

    rows: Columns of sources, one for each patch; patches: rows of PATCH_COLUMNS
    found: rows of FOUND_COLUMNS, sources in residuals, for the next round
    components: rows of COMPONENT_COLUMNS, offsets counted in `flat`; spectra: (C,) of each; thetas:
        (N_PARAMETERS,) of each, of its profile, padded with NaN
    scales: rows of SCALE_COLUMNS, of the structure of components that another round goes on from;
        strengths: of each; coefficients: of these, flattened
    flat: morphologies, flattened; models: rows of MODEL_COLUMNS, pixels: of these, flattened
    offsets: (1 + 2 M + C,) of each patch with fitted shifts or sky levels other than 0: its number,
        shifts (M, 2) [model px] of all mosaics, sky levels (C,) [counts] of all channels
    n_failed: patches without a fit
    """

    rows: list = field(default_factory=list)
    patches: list = field(default_factory=list)
    found: list = field(default_factory=list)
    components: list = field(default_factory=list)
    spectra: list = field(default_factory=list)
    thetas: list = field(default_factory=list)
    scales: list = field(default_factory=list)
    strengths: list = field(default_factory=list)
    coefficients: list = field(default_factory=list)
    flat: list = field(default_factory=list)
    models: list = field(default_factory=list)
    pixels: list = field(default_factory=list)
    offsets: list = field(default_factory=list)
    n_flat: int = 0
    n_pixels: int = 0
    n_failed: int = 0

    def add_component(self, source_id, patch, origin, morphology, spectrum, theta, structure=None):
        """A component of a source: its box begins at `origin` (2,) of the field's model pixels.

        theta (n,): parameters of its profile; structure: its ComponentStructure, None = not stored
        """
        if structure is not None:
            rows = zip(structure.coefficients, structure.strengths, strict=True)
            for z, strength in rows:
                self.scales.append((len(self.components), *z.shape, structure.clear))
                self.strengths.append(strength)
                self.coefficients.append(np.ravel(z).astype(np.float32))
        where = (source_id, patch.parent, patch.number, *origin, *morphology.shape, self.n_flat)
        self.components.append(tuple(map(int, where)))
        self.spectra.append(spectrum)
        self.thetas.append(np.pad(theta, (0, N_PARAMETERS - len(theta)), constant_values=np.nan))
        self.flat.append(np.ravel(morphology).astype(np.float32))
        self.n_flat += morphology.size

    def add_model(self, patch, i_mosaic, box, model):
        """All sources of a patch (C, Ny, Nx) [counts], rendered on a Box of a mosaic."""
        self.models.append((patch.number, i_mosaic, len(model), *box, self.n_pixels))
        self.pixels.append(np.ravel(model).astype(np.float32))
        self.n_pixels += model.size

    def add_offsets(self, patch, shifts, sky):
        """A patch's shifts (M, 2) [model px] and sky levels (C,) [counts], if any is not 0."""
        if np.any(shifts) or np.any(sky):
            self.offsets.append(np.concatenate([[patch.number], np.ravel(shifts), sky]))

    def to_bytes(self) -> bytes:
        """The file that GroupResultsFile reads.

        A line of JSON, {table: [metadata, [[column, unit, type, shape], ...]]}, then the bytes of
        all columns. An array is a table with one column "". As FITS tables the same content took
        130 ms to write and 11 to 60 ms for each time that a table was read, here 4 and 0.4 to 2.
        """
        tables = {
            "CATALOGUE": Columns.concatenate([rows for rows in self.rows if len(rows)]),
            "PATCHES": typed_rows(self.patches, PATCH_COLUMNS),
            "FOUND": typed_rows(self.found, FOUND_COLUMNS),
            "COMPONENTS": _whole(self.components, COMPONENT_COLUMNS),
            "SPECTRA": _array(self.spectra),
            "THETAS": _array(self.thetas),
            "SCALES": _whole(self.scales, SCALE_COLUMNS),
            "STRENGTHS": _array(self.strengths),
            "COEFFICIENTS": _pixels(self.coefficients),
            "MORPHOLOGIES": _pixels(self.flat),
            "MODELS": _whole(self.models, MODEL_COLUMNS),
            "PIXELS": _pixels(self.pixels),
            "OFFSETS": _array(self.offsets),
        }
        index = {name: _index(name, rows) for name, rows in tables.items()}
        line = json.dumps(index).encode() + b"\n"
        arrays = (array for rows in tables.values() for array in rows.values.values())
        return b"".join([line, *(array.tobytes() for array in arrays)])


def typed_rows(rows, kinds):
    """The Columns of rows; kinds {name: ColumnDefinition}."""
    columns, found = zip(*rows, strict=True) if rows else [()] * len(kinds), Columns()
    for (name, kind), values in zip(kinds.items(), columns, strict=True):
        found.put(name, np.array(values, kind.dtype), kind.unit)
    return found


def _whole(rows, names):
    values = np.array(rows, np.int64).reshape(-1, len(names))
    return Columns(dict(zip(names, values.T, strict=True)))


def _array(values):
    return Columns({"": np.array(values)})


def _pixels(images):
    return _array(np.concatenate([np.zeros(0, np.float32), *images]))


def _index(name, rows):
    """Metadata of a table, as in the catalogue, and (name, unit, type, shape) of its columns."""
    meta = {key.upper(): value for key, value in rows.meta.items()} | {"EXTNAME": name}
    units = {column: unit.to_string("fits") for column, unit in rows.units.items()}
    arrays = rows.values.items()
    return meta, [(column, units.get(column, ""), a.dtype.str, a.shape) for column, a in arrays]


class _ArrayFile:
    """The open file of `GroupResults.to_bytes`. Raises ValueError if it is not complete."""

    def __init__(self, file):
        self.file, self.tables, self.starts = file, json.loads(file.readline()), {}
        start = file.tell()
        for name, (_, columns) in self.tables.items():
            self.starts[name] = start
            start += sum(np.dtype(dtype).itemsize * math.prod(n) for *_, dtype, n in columns)
        if start != (size := os.fstat(file.fileno()).st_size):
            raise ValueError(f"{size} bytes in place of {start}")

    def read(self, name):
        """The Columns of a table, or an array."""
        meta, columns = self.tables[name]
        found = Columns(meta=meta)
        self.file.seek(self.starts[name])
        for column, unit, dtype, shape in columns:
            values = np.fromfile(self.file, dtype, math.prod(shape)).reshape(shape)
            found.put(column, values, u.Unit(unit, format="fits") if unit else None)
        return found.values.get("", found)

    def pixels(self, name, start, shape):
        """An image in an array of float32, from the value `start` on."""
        self.file.seek(self.starts[name] + 4 * start)
        return np.fromfile(self.file, np.float32, math.prod(shape)).reshape(shape)


@dataclass(frozen=True)
class GroupResultsFile:
    """A part on disk."""

    path: Path

    @contextmanager
    def _open(self):
        """The _ArrayFile, within a `with`; every error on reading is a FileError."""
        try:
            with open(self.path, "rb") as file:
                yield _ArrayFile(file)
        except Exception as error:  # a damaged file may provoke any exception
            reason = " ".join(str(getattr(error, "strerror", None) or error).split())
            raise FileError(f"{self.path}: cannot be read, or is damaged ({reason})") from error

    def read(self, *names) -> list:
        """Reads tables, each as Columns, and arrays. Raises FileError."""
        with self._open() as file:
            return [file.read(name) for name in names]

    def last_fits(self, corners) -> dict[int, tuple[dict, dict]]:
        """Profiles and structures of some patches' sources, {patch: (profiles, structures)}.

        Profiles {id: parameters (n,) of each component}; structures {id: ComponentStructure of
        each component}, None for those without

        corners {patch: (2,) [px]}: first pixel of its frame in the field's model pixels
        """
        found: dict[int, tuple[dict, dict]] = {patch: ({}, {}) for patch in corners}
        table, scales, thetas, strengths, flat = self.read(
            "COMPONENTS", "SCALES", "THETAS", "STRENGTHS", "COEFFICIENTS"
        )
        rows = np.stack([scales[name] for name in SCALE_COLUMNS], axis=1)
        ends = np.cumsum(rows[:, 1] * rows[:, 2])
        places = np.stack([table["y0"], table["x0"]], axis=1)
        of_component = zip(table["id"].tolist(), table["fit_id"].tolist(), strict=True)
        for i, (source, patch) in enumerate(of_component):
            if patch not in found:
                continue
            own, one = np.flatnonzero(rows[:, 0] == i), None
            if len(own):
                start = int(ends[own[0]] - rows[own[0], 1:3].prod())
                parts = np.split(flat[start : ends[own[-1]]], ends[own[:-1]] - start)
                one = ComponentStructure(
                    tuple((places[i] - corners[patch]).tolist()),
                    tuple(z.reshape(k[1:3]) for z, k in zip(parts, rows[own], strict=True)),
                    strengths[own],
                    bool(rows[own[0], 3]),
                )
            theta = tuple(thetas[i][np.isfinite(thetas[i])].tolist())
            for of_source, value in zip(found[patch], (theta, one), strict=True):
                of_source[source] = (*of_source.get(source, ()), value)
        return found

    def models(self, chosen=None, mosaic=None):
        """(patch, mosaic, Box, model (C, Ny, Nx)) of its patches, or of those in `chosen`.

        All mosaics are included, or the one with a number.
        """
        with self._open() as file:
            index = file.read("MODELS")
            rows = zip(*(index[name].tolist() for name in MODEL_COLUMNS), strict=True)
            for patch, i_mosaic, n_channels, *corners, start in rows:
                if (chosen is None or patch in chosen) and mosaic in (None, i_mosaic):
                    shape = n_channels, *(box := Box(*corners)).shape
                    yield patch, i_mosaic, box, file.pixels("PIXELS", start, shape)


def results_file(folder, name) -> GroupResultsFile:
    """The results of a group of a name in the run's folder."""
    return GroupResultsFile(folder / f"{name}.arrays")


def last_rounds(tables) -> dict:
    """{fit_id: number of the table with its last round}; tables: rows of PATCH_COLUMNS of parts."""
    last: dict[int, int] = {}
    n_round: dict[int, int] = {}
    for i, rows in enumerate(tables):
        for patch, one in zip(rows["fit_id"].tolist(), rows["n_refits"].tolist(), strict=True):
            if one >= n_round.get(patch, -1):
                last[patch], n_round[patch] = i, one
    return last
