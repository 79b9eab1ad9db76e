"""Tables as Parquet, with the units and descriptions of their columns."""

from __future__ import annotations

import numpy as np

from .. import __version__


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
    """Write a QTable to Parquet, units and descriptions in the metadata of its columns."""
    from pyarrow import parquet

    parquet.write_table(arrow_table(table), path)
