"""Tables as Parquet and back, with the units and descriptions of their columns."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.table import Column, QTable

from .. import __version__

NO_PYARROW = "Parquet needs pyarrow, which is not installed: pip install 'clresample[field]'"


def arrow_table(table):
    """A QTable as pyarrow.Table, units and descriptions in the metadata of its columns."""
    import pyarrow as pa

    arrays, fields = [], []
    for name in table.colnames:
        column = table[name]
        values = np.asarray(getattr(column, "value", column))
        values = values.astype(values.dtype.newbyteorder("="), copy=False)  # of FITS tables
        array = pa.array(values.tolist() if values.dtype.kind in "US" else values)
        unit = str(column.unit) if getattr(column, "unit", None) is not None else ""
        about = {"unit": unit, "description": column.info.description or ""}
        arrays.append(array)
        fields.append(pa.field(name, array.type, metadata={k: v for k, v in about.items() if v}))
    meta = {str(k): str(v) for k, v in table.meta.items()}
    meta["creator"] = f"clresample {__version__}"
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=meta))


def write_parquet(path, table):
    """Writes a QTable to Parquet, units and descriptions in the metadata of its columns.

    Raises ImportError, with what to install, without pyarrow.
    """
    _parquet().write_table(arrow_table(table), path)


def read_parquet(path) -> QTable:
    """The table of a Parquet file, with the units and descriptions of its columns, if any.

    Raises ImportError, with what to install, without pyarrow.
    """
    found = _parquet().read_table(path)
    table = QTable(meta=_texts(found.schema.metadata))
    for field, values in zip(found.schema, found.columns, strict=True):
        values, about = values.to_numpy(), _texts(field.metadata)
        values = values.astype(str) if values.dtype.kind == "O" else np.array(values)
        table[field.name] = values * u.Unit(about["unit"]) if "unit" in about else Column(values)
        if "description" in about:
            table[field.name].info.description = about["description"]
    return table


def _texts(metadata):
    """Metadata of Parquet as texts, without other packages' entries."""
    pairs = (metadata or {}).items()
    return {k.decode(): v.decode() for k, v in pairs if k not in (b"pandas", b"ARROW:schema")}


def _parquet():
    """Imports pyarrow. Raises ImportError that names the package to install."""
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(NO_PYARROW) from error
    return parquet
