"""The model's pixels of a field, and a check that its mosaics are consistent."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..files.fits_names import check_columns, to_ascii
from ..sky.grid import Grid
from .model_mosaics import file_name


def reference_grid(mosaics) -> Grid:
    """The grid of the mosaic with the smallest pixels, the first if several are equal.

    Raises ValueError without mosaics, for names or channels that are repeated or not valid in
    tables, and if only some mosaics have zero points or a WCS.
    """
    if not mosaics:
        raise ValueError("mosaics is empty, at least one is needed")
    for what, names in (
        ("name", [m.name for m in mosaics]),
        ("file name", [file_name(m.name) for m in mosaics]),
        ("channel", [c.name for m in mosaics for c in m.channels]),
    ):
        if len(set(names)) < len(names):
            raise ValueError(f"{what}s of mosaics must be unique, not {', '.join(names)}")
    _check_names(mosaics)
    for what, have in (
        ("zero points", [m.channels[0].zero_point is not None for m in mosaics]),
        ("a WCS", [not m.grid.is_flat for m in mosaics]),
    ):
        if len(set(have)) > 1:
            has, none = (mosaics[have.index(there)].name for there in (True, False))
            raise ValueError(f"mosaic {has!r} has {what}, {none!r} has none: give all or none")
    scales = [m.grid.pixel_scale_arcsec for m in mosaics]
    return mosaics[int(np.argmin(scales))].grid


def _check_names(mosaics):
    """Raises ValueError for names of mosaics or channels that tables cannot hold."""
    for what, name in [
        *(("name", m.name) for m in mosaics),
        *(("channel", c.name) for m in mosaics for c in m.channels),
        *(("band", c.band) for m in mosaics for c in m.channels if c.band),
    ]:
        if to_ascii(name) != name or name != name.rstrip():
            raise ValueError(
                f"{what} {name!r} must be printable ASCII without a space at its end, for "
                "columns of FITS tables: give another one"
            )
    check_columns(f"chi2_{m.name}" for m in mosaics)
    bands = list(dict.fromkeys(c.band or c.name for m in mosaics for c in m.channels))
    check_columns(f"group_flux_err_{band}" for band in bands)
    check_columns(f"colour_err_{a}_{b}" for a, b in pairwise(bands))
