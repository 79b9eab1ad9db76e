"""Reads catalogues from FITS, ECSV and Parquet, and writes them."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyWarning

from ..measurement.catalogue import FLAG_MEANINGS
from ..sky.validation.checks import check_instance
from .atomic import FileError, atomic_file, check_output
from .fits import write_hdus
from .fits_names import check_columns, to_ascii
from .parquet import read_parquet, write_parquet

ENDINGS = ".ecsv", ".parquet", ".fits", ".fits.gz"


def read_catalogue(path) -> QTable:
    """Reads a catalogue from a FITS, ECSV or Parquet file, with units and descriptions.

    Parquet needs pyarrow (the extra `field`), not pandas. Texts are str, nothing is masked.

    path: a file written by `write_catalogue` or `run_field`, or any table of these formats

    Raises FileError for a file that does not exist or is not a table; ImportError without pyarrow.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    form = {"format": "ascii.ecsv"} if path.suffix == ".ecsv" else {}
    try:
        if path.suffix == ".parquet":
            return read_parquet(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)  # units that astropy repairs
            table = QTable.read(path, **form)
    except ImportError:
        raise
    except Exception as error:  # a damaged file may provoke any exception in astropy
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: cannot be read as a table ({reason})") from error
    table = _with_text(table)
    for i, name in enumerate(table.colnames, start=1):
        if text := table.meta.pop(f"TCOMM{i}", None):
            table[name].info.description = text
    return table


def write_catalogue(path, table, *, overwrite=False):
    """Writes a catalogue, whole or not at all: as ECSV or, by the file's name, FITS or Parquet.

    path: ends in .ecsv, .parquet, .fits or .fits.gz; table: of `catalogue`
    overwrite: replace an existing file
    Raises FileError when the file exists or cannot be written, ValueError for other endings
    and columns' names too long for FITS; ImportError without pyarrow for Parquet.
    """
    path = Path(path)
    if not path.name.endswith(ENDINGS):
        raise ValueError(f"path is {path.name}, a catalogue ends in {', '.join(ENDINGS)}")
    check_instance("table", table, Table)
    check_output(path, overwrite=overwrite)
    if ".fits" in path.suffixes:
        return write_hdus(
            path, [fits.PrimaryHDU(), table_hdu(table, "CATALOGUE"), flag_table_hdu()]
        )
    with atomic_file(path) as part:
        if path.suffix == ".parquet":
            return write_parquet(part, table)
        table.write(part, format="ascii.ecsv", overwrite=True)


def table_hdu(table, name):
    """Converts a table to an HDU; characters outside ASCII, which FITS lacks, become "?".

    Descriptions of columns become the cards TCOMMn, as tools of the Virtual Observatory read them.
    """
    check_columns(table.colnames)
    about = [table[column].info.description for column in table.colnames]
    table = QTable(table, names=[to_ascii(column) for column in table.colnames])
    if "name" in table.colnames:
        table["name"] = [to_ascii(value) for value in table["name"]]
    hdu = fits.table_to_hdu(table)
    hdu.name = name
    for i, text in enumerate(about, start=1):
        if text:
            hdu.header[f"TCOMM{i}"] = to_ascii(text)
    return hdu


def flag_table_hdu():
    """The meanings of `flags` as an HDU."""
    rows = [(flag.name, flag.value, meaning) for flag, meaning in FLAG_MEANINGS.items()]
    return fits.BinTableHDU(Table(rows=rows, names=("flag", "value", "meaning")), name="FLAGS")


def _with_text(table):
    """Converts bytes of a table to text and fills its masked values."""
    for name in table.colnames:
        column, about = table[name], table[name].info.description
        kind = getattr(getattr(column, "dtype", None), "kind", "")
        if kind in "SUO":
            plain = np.ma.filled(np.ma.asarray(column), b"" if kind == "S" else "")
            table[name] = [
                v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in plain
            ]
        elif hasattr(column, "filled"):
            table[name] = column.filled(np.nan if kind == "f" else 0)
        table[name].info.description = about
    return table
