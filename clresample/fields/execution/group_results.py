"""Results of a group of fits on disk: one FITS file, written atomically."""

from __future__ import annotations

from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits

from ...deblending.linear.equations import N_PARAMETERS
from ...deblending.solver.scene import ComponentStructure
from ...files.fits import open_fits
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
META = "FRAME", "EXTNAME"  # cards of a table's header that enter its Columns too
FITS_FORMATS = {"int16": "I", "int32": "J", "int64": "K", "float32": "E", "float64": "D"}
FOUND_COLUMNS = {
    "fit_id": PATCH_COLUMNS["fit_id"],
    **{name: DEFINITIONS[name] for name in ("id", "y", "x")},
    "host": DEFINITIONS["group_id"],
}
COMPONENT_COLUMNS = ("id", "parent_id", "fit_id", "y0", "x0", "n_y", "n_x", "offset")
SCALE_COLUMNS = ("component", "n_y", "n_x", "clear")
MODEL_COLUMNS = ("fit_id", "mosaic", "y0", "x0", "y1", "x1", "offset")


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
        self.models.append((patch.number, i_mosaic, *box, self.n_pixels))
        self.pixels.append(np.ravel(model).astype(np.float32))
        self.n_pixels += model.size

    def add_offsets(self, patch, shifts, sky):
        """A patch's shifts (M, 2) [model px] and sky levels (C,) [counts], if any is not 0."""
        if np.any(shifts) or np.any(sky):
            self.offsets.append(np.concatenate([[patch.number], np.ravel(shifts), sky]))

    def to_bytes(self) -> bytes:
        """The file that GroupResultsFile reads."""
        hdus = [
            fits.PrimaryHDU(),
            _table(Columns.concatenate([rows for rows in self.rows if len(rows)]), "CATALOGUE"),
            _table(typed_rows(self.patches, PATCH_COLUMNS), "PATCHES"),
            _table(typed_rows(self.found, FOUND_COLUMNS), "FOUND"),
            _table(_whole(self.components, COMPONENT_COLUMNS), "COMPONENTS"),
            _floats(self.spectra, "SPECTRA"),
            _floats(self.thetas, "THETAS"),
            _table(_whole(self.scales, SCALE_COLUMNS), "SCALES"),
            _floats(self.strengths, "STRENGTHS"),
            _floats(self.coefficients and np.concatenate(self.coefficients), "COEFFICIENTS"),
            _floats(self.flat and np.concatenate(self.flat), "MORPHOLOGIES"),
            _table(_whole(self.models, MODEL_COLUMNS), "MODELS"),
            _floats(self.pixels and np.concatenate(self.pixels), "PIXELS"),
            _floats(self.offsets, "OFFSETS"),
        ]
        file = BytesIO()
        fits.HDUList(hdus).writeto(file)
        return file.getvalue()


def typed_rows(rows, kinds):
    """The Columns of rows; kinds {name: ColumnDefinition}."""
    columns, found = zip(*rows, strict=True) if rows else [()] * len(kinds), Columns()
    for (name, kind), values in zip(kinds.items(), columns, strict=True):
        found.put(name, np.array(values, kind.dtype), kind.unit)
    return found


def _whole(rows, names):
    values = np.array(rows, np.int64).reshape(-1, len(names))
    return Columns(dict(zip(names, values.T, strict=True)))


def _table(columns, name):
    """The HDU of Columns; their meta are cards of its header."""
    found = []
    for key, values in columns.values.items():
        form, unit = FITS_FORMATS.get(values.dtype.name), columns.units.get(key)
        if form is None:  # text
            values = np.char.encode(values, "ascii")
            form = f"{max(1, values.dtype.itemsize)}A"
        unit = None if unit is None else unit.to_string("fits")
        found.append(fits.Column(key, form, unit, array=values))
    hdu = fits.BinTableHDU.from_columns(found, name=name) if found else fits.BinTableHDU(name=name)
    hdu.header.update(columns.meta)
    return hdu


def _floats(array, name):
    array = np.asarray(array)
    return fits.ImageHDU(array if array.size else None, name=name)


def _owners(components):
    """(id of the source, patch) of each of a table of COMPONENT_COLUMNS."""
    return list(zip(components["id"].tolist(), components["fit_id"].tolist(), strict=True))


@dataclass(frozen=True)
class GroupResultsFile:
    """A part on disk."""

    path: Path

    def read(self, *names) -> list:
        """Reads HDUs, native: the Columns of a table, an image's pixels; empty ones are skipped."""
        with open_fits(self.path) as hdus:
            chosen = [hdus[name] for name in names]
            return [_array(hdu) if hdu.is_image else _columns(hdu) for hdu in chosen]

    def owners(self) -> list[tuple[int, int]]:
        """(id of the source, patch) of each component."""
        return _owners(*self.read("COMPONENTS"))

    def last_fits(self, corners) -> dict[int, tuple[dict, dict]]:
        """Profiles and structures of some patches' sources, {patch: (profiles, structures)}.

        Profiles {id: parameters (n,) of each component}; structures {id: ComponentStructure of
        each component}, None for those without

        corners {patch: (2,) [px]}: first pixel of its frame in the field's model pixels
        """
        found: dict[int, tuple[dict, dict]] = {patch: ({}, {}) for patch in corners}
        with open_fits(self.path) as hdus:
            table, scales = _columns(hdus["COMPONENTS"]), _columns(hdus["SCALES"])
            thetas, strengths = _array(hdus["THETAS"]), _array(hdus["STRENGTHS"])
            rows = np.stack([scales[name] for name in SCALE_COLUMNS], axis=1)
            ends, flat = np.cumsum(rows[:, 1] * rows[:, 2]), hdus["COEFFICIENTS"]
            places = np.stack([table["y0"], table["x0"]], axis=1)
            for i, (source, patch) in enumerate(_owners(table)):
                if patch not in found:
                    continue
                own, one = np.flatnonzero(rows[:, 0] == i), None
                if len(own):
                    start = int(ends[own[0]] - rows[own[0], 1:3].prod())
                    z = np.array(flat.section[start : int(ends[own[-1]])], np.float32)
                    parts = np.split(z, ends[own[:-1]] - start)
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

    def offsets(self) -> np.ndarray:
        """The rows of `GroupResults.offsets`."""
        with open_fits(self.path) as hdus:
            rows = _array(hdus["OFFSETS"])
        return np.zeros((0, 1)) if not rows.size else rows.astype(np.float64)

    def models(self, chosen=None, mosaic=None):
        """(patch, mosaic, Box, model (C, Ny, Nx)) of its patches, or of those in `chosen`.

        All mosaics are included, or the one with a number.
        """
        with open_fits(self.path) as hdus:
            index, hdu = _columns(hdus["MODELS"]), hdus["PIXELS"]
            rows = np.stack([index[name] for name in MODEL_COLUMNS], axis=1).tolist()
            ends = [*index["offset"][1:].tolist(), hdu.header.get("NAXIS1", 0)] if rows else []
            for (patch, i_mosaic, *corners, start), end in zip(rows, ends, strict=True):
                if (chosen is None or patch in chosen) and mosaic in (None, i_mosaic):
                    image, box = np.array(hdu.section[start:end], np.float32), Box(*corners)
                    yield patch, i_mosaic, box, image.reshape(-1, *box.shape)


def last_rounds(tables) -> dict:
    """{fit_id: number of the table with its last round}; tables: rows of PATCH_COLUMNS of parts."""
    last: dict[int, int] = {}
    n_round: dict[int, int] = {}
    for i, rows in enumerate(tables):
        for patch, one in zip(rows["fit_id"].tolist(), rows["n_refits"].tolist(), strict=True):
            if one >= n_round.get(patch, -1):
                last[patch], n_round[patch] = i, one
    return last


def _columns(hdu):
    """The Columns of a table's HDU, native."""
    found = Columns(meta={k: hdu.header[k] for k in META if k in hdu.header})
    for column in hdu.columns:
        values = np.asarray(hdu.data[column.name])
        unit = column.unit and u.Unit(column.unit, format="fits")
        found.put(column.name, values.astype(values.dtype.newbyteorder("=")), unit)
    return found


def _array(hdu):
    """The pixels of an image's HDU, native; empty where it has none."""
    if hdu.data is None:
        return np.zeros(0, np.float32)
    return np.array(hdu.data, dtype=hdu.data.dtype.newbyteorder("="))
