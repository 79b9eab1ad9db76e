"""Columns of catalogues: their definitions, and tables while they are made.

A table is plain arrays until it becomes one astropy table at the end.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from astropy import units as u
from astropy.table import QTable

# Number of names whose definitions are cached: those of a catalogue of 100 channels.
MAX_NAMES = 1024


class ColumnDefinition(NamedTuple):
    """Description, unit and type of a column; unit None: none, or as its values have it."""

    description: str
    unit: Any = None
    dtype: Any = float


def definitions(given) -> dict[str, ColumnDefinition]:
    """ColumnDefinitions {name: ...} of descriptions, or tuples (description, unit, type)."""
    pairs = ((name, (one,) if isinstance(one, str) else one) for name, one in given.items())
    return {name: ColumnDefinition(*one) for name, one in pairs}


# Columns by name, of a blend's catalogue and of a field's.
DEFINITIONS = definitions(
    {
        "name": ("of the source: its own, or its number; in a field that of the list", None, "U"),
        "id": ("of the source: field, row, column of the model's pixel at it", None, np.int64),
        "parent_id": ("id of the brightest source detected in the same blend", None, np.int64),
        "group_id": ("of its group: its first row, in a field its brightest id", None, np.int64),
        "n_group": ("sources of the group", None, np.int32),
        "flags": ("sum of what limits the measurement", None, np.int32),
        "status": ("how the fit ended", None, "U"),
        "reason": ("why it failed, or was cut", None, "U"),
        "n_blend_sources": ("sources that were detected in the blend", None, np.int32),
        "detection_pass": ("1 = detected before the fit, 2 = in its residuals", None, np.int16),
        "detection_snr": "signal to noise of the detection, all instruments together",
        "snr": "signal to noise of all bands together, negative fluxes as 0",
        "y": ("row of the position in the model's pixels, from 0", u.pix),
        "x": ("column of the position in the model's pixels, from 0", u.pix),
        "ra": ("right ascension of the position", u.deg),
        "dec": ("declination of the position", u.deg),
        "y_sky": ("of the position on the flat sky", u.arcsec),
        "x_sky": ("of the position on the flat sky", u.arcsec),
        "n_components": ("of the model: 2 where its core differs from the rest", None, np.int64),
        "rms_size": ("root of the mean second moment of light under the model's PSF", u.arcsec),
        "e1": "ellipticity of the fitted light: above 0 where it is stretched north - south",
        "e2": "ellipticity of the fitted light: above 0 if stretched north-east - south-west",
        "position_angle": ("of the fitted light's long axis, east of north", u.deg),
        "misfit_sigma": "largest residual, or excess of chi2, in any channel, in sigma",
        "misfit_fraction": "light that the model leaves over the flux, 0 if not significant",
        "ambiguous_with": ("id or row of the source that has its light, or -1", None, np.int64),
    }
)
# Columns of each channel, band or instrument, by what their names begin with.
PREFIXES = definitions(
    {
        "group_flux_err_": "error of the flux of all of the group in {}",
        "group_flux_": "flux of all of the group in {}",
        "flux_err_": "error of the flux in {}",
        "flux_": "total flux in {}",
        "mag_err_": ("error of the magnitude in {}", u.mag),
        "mag_": ("AB magnitude of the total flux in {}", u.mag),
        "colour_err_": ("error of the colour {}", u.mag),
        "colour_": ("colour {}: AB magnitude in its first band minus that in its second", u.mag),
        "chi2_": "mean chi2 of the source's pixels in {}",
        "max_residual_": "largest residual on the source in {}, in sigma",
    }
)
# Columns beside others, by what their names end with; their units are those of the others.
SUFFIXES = {"_err": "error of {}", "_centroid": "{} of the fitted light's centroid"}


@functools.lru_cache(maxsize=MAX_NAMES)
def definition(name) -> ColumnDefinition:
    """The definition of a column; an empty one of a name that no catalogue has."""
    if name in DEFINITIONS:
        return DEFINITIONS[name]
    for prefix, found in PREFIXES.items():
        if name.startswith(prefix):
            return found._replace(description=found.description.format(name.removeprefix(prefix)))
    for suffix, text in SUFFIXES.items():
        if name.endswith(suffix):
            stem = name.removesuffix(suffix)
            return ColumnDefinition(text.format(stem), definition(stem).unit)
    return ColumnDefinition("")


# Values of rows without one, by the kind of the column.
EMPTY = {"i": 0, "u": 0, "b": False, "U": ""}


class Columns:
    """Arrays (n,) by name, in the order in which they came, some with units.

    An astropy table takes 0.2 ms for each column that it gets, loses or joins: a catalogue of one
    blend has 60 of them, a field has thousands of blends.

    values {name: array}, units {name: unit}; meta: metadata of the whole table
    """

    def __init__(self, values=None, units=None, meta=None):
        self.values, self.units, self.meta = values or {}, units or {}, meta or {}

    def __len__(self):
        return len(next(iter(self.values.values()), ()))

    def __contains__(self, name):
        return name in self.values

    def __getitem__(self, name) -> np.ndarray:
        return self.values[name]

    def put(self, name, values, unit=None):
        """Sets a column; a new one becomes the last. Its unit is that of its definition if None."""
        self.values[name] = np.asarray(values)
        unit = definition(name).unit if unit is None else unit
        if unit is not None:
            self.units[name] = unit

    def select_rows(self, which) -> Columns:
        """The rows of an index: a slice, numbers or bool."""
        rows = {name: values[which] for name, values in self.values.items()}
        return Columns(rows, dict(self.units), dict(self.meta))

    @classmethod
    def concatenate(cls, several) -> Columns:
        """Concatenates the rows of several, with names in the order of first appearance.

        Rows without a column get NaN, 0 for whole numbers, "" for texts.
        """
        found = cls()
        for one in several:
            found.units = one.units | found.units
            found.meta = one.meta | found.meta
            for name, values in one.values.items():
                found.values.setdefault(name, values)
        for name, like in found.values.items():
            empty = EMPTY.get(like.dtype.kind, np.nan)
            found.values[name] = np.concatenate(
                [
                    one[name] if name in one else np.full(len(one), empty, like.dtype)
                    for one in several
                ]
            )
        return found

    def table(self) -> QTable:
        """The same as an astropy table, with the descriptions of its columns."""
        table = QTable(
            [
                values.copy() if name not in self.units else values * self.units[name]
                for name, values in self.values.items()
            ],
            names=list(self.values),
            meta=self.meta,
            copy=False,
        )
        for name in table.colnames:
            table[name].info.description = definition(name).description or None
        return table

    @classmethod
    def without_rows(cls, names) -> Columns:
        """Columns of no row, with the types of their definitions."""
        found = cls()
        for name in names:
            found.put(name, np.zeros(0, definition(name).dtype))
        return found
