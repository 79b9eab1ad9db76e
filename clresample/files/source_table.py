"""Lists of sources, in any format that astropy reads."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from ..sky.sources import ExtendedSource, PointSource, check_unique_names
from .headers import check_headers

KINDS = {"point": PointSource, "extended": ExtendedSource}
# Quantities of columns; the column has the same name unless the scene file specifies another.
COLUMNS = ("ra", "dec", "y", "x", "name", "type", "components", "observation")


def read_sources(path, columns=None) -> tuple:
    """Sources of a table: their positions `ra` and `dec` or `y` and `x`, names, types, components.

    path: a file that `astropy.table.Table.read` takes
    columns: {what: column's name} for ra, dec [deg, or the column's own unit], y, x [px, counted
        from 0], observation (in whose pixels y and x count; none or "" = in the model's), name,
        type ("point" or "extended"), components (number of components of an extended source;
        masked = decided by the data); and
        format: astropy's name of it. By default each column has the name of its quantity
    returns a tuple of PointSource and ExtendedSource; sources without a type are extended

    Raises ValueError, one line that names file, column and row.
    """
    columns, path = columns or {}, Path(path)
    table = _read(path, columns.get("format"))
    found = {}
    for what in COLUMNS:
        name = columns.get(what, what)
        if name in table.colnames:
            found[what] = table[name]
        elif what in columns:
            raise ValueError(
                f"{what} is {name!r}, {path} has the columns {', '.join(table.colnames)}"
            )
    if not len(table):
        raise ValueError(f"{path}: holds no source")
    asked = {what for what in columns if what in COLUMNS[:4]}
    pairs = [
        pair
        for pair in (("ra", "dec"), ("y", "x"))
        if all(one in found for one in pair) and (not asked or asked & set(pair))
    ]
    if not pairs:
        raise ValueError(
            f"{path}: has neither the columns ra and dec nor y and x, but "
            f"{', '.join(table.colnames)}; name them with ra = ..., dec = ..."
        )
    sky = pairs[0] == ("ra", "dec")
    unit = "deg" if sky else "pix"
    values = [_numbers(path, what, found[what], unit) for what in pairs[0]]
    position = "sky_deg" if sky else "position_px"
    sources = []
    for i, where in enumerate(zip(*values, strict=True)):
        try:
            sources.append(_source(found, i, {position: tuple(map(float, where))}))
        except ValueError as error:
            raise ValueError(f"{path}: row {i + 1}: {error}") from error
    try:
        check_unique_names(sources)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return tuple(sources)


def _read(path, name):
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    check_headers(path)
    try:
        with warnings.catch_warnings():  # about types outside ECSV, which are read nevertheless
            warnings.simplefilter("ignore", AstropyWarning)
            return Table.read(path, format=name)
    except Exception as error:  # readers raise any exception on a file of another format
        reason = str(error).strip().split("\n")[0]
        raise ValueError(
            f"{path}: no table that astropy can read ({reason}); format = ... says which it is"
        ) from error


def _numbers(path, what, column, unit):
    """Values of a column (n,) float64, in `unit` where it has a unit; masked rows are NaN."""
    try:
        if column.unit is not None:
            column = (
                column.to(unit) if not hasattr(column, "mask") else column.filled(np.nan).to(unit)
            )
        values = getattr(column, "value", column)
        if np.asarray(values).dtype.kind in "cmM":
            raise ValueError(f"its type is {np.asarray(values).dtype}")
        values = np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
    except Exception as error:  # astropy and NumPy raise several on texts and other units
        raise ValueError(f"{path}: column {what} is not a position in {unit} ({error})") from error
    if values.ndim != 1:
        raise ValueError(
            f"{path}: column {what} has {values.shape[1:]} values a row, a position takes one"
        )
    return values


def _source(found, i, given):
    if "name" in found and found["name"][i] is not np.ma.masked:
        given["name"] = str(found["name"][i])
    if "observation" in found and "position_px" in given:
        where = found["observation"][i]
        given["observation"] = None if where is np.ma.masked else str(where).strip() or None
    kind = str(found["type"][i]).strip().lower() if "type" in found else "extended"
    if kind not in KINDS:
        raise ValueError(f"type is {kind!r}, must be {' or '.join(KINDS)}")
    chosen = "components" in found and found["components"][i] is not np.ma.masked
    if kind == "extended" and chosen:
        given["n_components"] = _whole("components", found["components"][i])
    return KINDS[kind](**given)


def _whole(what, value):
    """The whole number that a table's cell holds, whatever its type. Raises ValueError."""
    try:
        number = float(value)
        whole = int(number)
    except (TypeError, ValueError, OverflowError):
        number, whole = math.nan, 0
    if number != whole:
        raise ValueError(f"{what} is {value!s:.80}, must be a whole number")
    return whole
