"""Writes a catalogue in the HATS layout, for LSDB to open, match and join at any size.

    hats/hats.properties            names of columns, number of rows
    hats/partition_info.csv         pixels of the partitions
    hats/dataset/_metadata          all partitions' row groups, with the names of their files
    hats/dataset/_common_metadata   the columns with their units and descriptions
    hats/dataset/Norder=K/Dir=D/Npix=N.parquet

A partition holds the rows in one HEALPix pixel N of order K, NESTED; D is N rounded down to ten
thousands. A pixel with more rows than one partition may have is divided into its four. Rows are
sorted by `_healpix_29`, their pixel of order 29, in a column of that name.

Source: the IVOA note on HATS (Caplar et al.), version 1.0.
"""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .. import __version__
from ..files.atomic import FileError, WriteError
from ..files.parquet import arrow_table
from ..sky.wcs import axis_names

FINEST = 29  # order of the index: pixels of 0.4 milliarcseconds, the finest that int64 numbers
INDEX = f"_healpix_{FINEST}"
# Rows of a partition: a row takes 1 kB, and each of LSDB's workers has a few partitions in memory.
# With more rows they need gigabytes; with fewer there are thousands of files for a sky survey.
MAX_ROWS = 300_000
LARGEST_ORDER = 10  # pixels of 3.4 arcminutes, smaller than a tile: no partition is divided further


def check_hats(grid):
    """Raises, before a run begins, the errors of a HATS catalogue that cannot be written.

    ValueError for a field whose catalogue will have no ra and dec, and ImportError without pyarrow
    or astropy-healpix.

    grid: of the model's pixels
    """
    if grid.is_flat or axis_names(grid.wcs) != ("ra", "dec"):
        raise ValueError(
            f"HATS needs right ascension and declination, the field is {grid.sky_description}"
        )
    if not find_spec("pyarrow"):
        raise ImportError("HATS needs pyarrow, which is not installed: pip install pyarrow")
    healpix_index([0.0], [0.0])


def healpix_index(ra, dec) -> np.ndarray:
    """Pixels (S,) of order 29, NESTED, of points (S,) [deg, ICRS].

    Raises ImportError without astropy-healpix, and ValueError for points that are not finite.
    """
    try:
        from astropy_healpix.core import lonlat_to_healpix
    except ImportError as error:
        raise ImportError(
            "HATS needs astropy-healpix, which is not installed: pip install astropy-healpix"
        ) from error
    from astropy import units as u

    ra, dec = np.asarray(ra, np.float64), np.asarray(dec, np.float64)
    bad = ~(np.isfinite(ra) & np.isfinite(dec))
    if bad.any():
        raise ValueError(f"ra and dec have {bad.sum()} rows of {bad.size} that are not finite")
    found = lonlat_to_healpix(ra * u.deg, dec * u.deg, 2**FINEST, order="nested")
    return np.asarray(found, np.int64)


def partitions(index, most=MAX_ROWS) -> list[tuple[int, int]]:
    """The (order, pixel) of each partition of rows with these pixels of order 29, in their order.

    Each has the lowest order at which a pixel has at most `most` rows, up to LARGEST_ORDER.
    """
    found, ahead = [], [(0, int(pixel)) for pixel in np.unique(index >> 2 * FINEST)[::-1]]
    order_of_rows = np.sort(index)
    while ahead:
        order, pixel = ahead.pop()
        shift = 2 * (FINEST - order)
        n = np.diff(np.searchsorted(order_of_rows, [pixel << shift, (pixel + 1) << shift]))[0]
        if n == 0:
            continue
        if n <= most or order == LARGEST_ORDER:
            found.append((order, pixel))
        else:
            ahead += [(order + 1, 4 * pixel + k) for k in (3, 2, 1, 0)]
    return found


def write_hats(folder, table, *, name="clresample", most_rows=MAX_ROWS) -> Path:
    """Writes a catalogue of a field, or of several, in the HATS layout.

    folder: to make; one of this name that holds HATS is replaced
    table: QTable with ra and dec [deg, ICRS]
    name: of the catalogue; most_rows: of a partition

    The folder appears once it is complete. Raises ValueError without ra and dec or without rows,
    ImportError without pyarrow or astropy-healpix, FileError where it cannot be written.
    """
    folder = Path(folder)
    if not {"ra", "dec"} <= set(table.colnames):
        raise ValueError("HATS needs columns ra and dec, which a field on a flat sky does not have")
    if not len(table):
        raise ValueError("HATS needs rows, the catalogue has none")
    if folder.exists() and not (folder / "hats.properties").is_file():
        raise FileError(f"{folder}: exists already and holds no HATS, and is kept")
    index = healpix_index(*(getattr(table[key], "value", table[key]) for key in ("ra", "dec")))
    part, old = (folder.with_name(f".{folder.name}-{what}") for what in ("part", "old"))
    try:
        for left in (part, old):
            shutil.rmtree(left, ignore_errors=True)
        _write(part, arrow_table(table), index, name, most_rows)
        if folder.exists():
            folder.rename(old)
        part.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error
    return folder


def _write(folder, table, index, name, most_rows):
    """Writes the files into a new folder. table: pyarrow.Table; index (S,): of its rows."""
    import pyarrow as pa
    from pyarrow import parquet

    about = {"description": f"HEALPix pixel of order {FINEST}, NESTED"}
    field = pa.field(INDEX, pa.int64(), nullable=False, metadata=about)
    table = table.append_column(field, pa.array(index))
    table = table.take(np.argsort(index, kind="stable"))
    index = np.sort(index)
    dataset, groups, pixels = folder / "dataset", [], partitions(index, most_rows)
    for order, pixel in pixels:
        shift = 2 * (FINEST - order)
        start, stop = np.searchsorted(index, [pixel << shift, (pixel + 1) << shift])
        place = f"Norder={order}/Dir={pixel // 10000 * 10000}/Npix={pixel}.parquet"
        (dataset / place).parent.mkdir(parents=True, exist_ok=True)
        group: list = []
        parquet.write_table(table[start:stop], dataset / place, metadata_collector=group)
        group[0].set_file_path(place)
        groups += group
    parquet.write_metadata(table.schema, dataset / "_metadata", metadata_collector=groups)
    parquet.write_metadata(table.schema, dataset / "_common_metadata")
    rows = "".join(f"{order},{pixel}\n" for order, pixel in pixels)
    (folder / "partition_info.csv").write_text(f"Norder,Npix\n{rows}")
    properties = {
        "obs_collection": name,
        "dataproduct_type": "object",
        "hats_nrows": len(table),
        "hats_col_ra": "ra",
        "hats_col_dec": "dec",
        "hats_col_healpix": INDEX,
        "hats_col_healpix_order": FINEST,
        "hats_npix_suffix": ".parquet",
        "hats_order": max(order for order, _ in pixels),
        "hats_max_rows": most_rows,
        "hats_builder": f"clresample {__version__}",
        "hats_version": "v1.0",
    }
    text = "".join(f"{key}={value}\n" for key, value in properties.items())
    (folder / "hats.properties").write_text(f"#HATS catalog\n{text}")
