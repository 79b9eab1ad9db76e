"""The catalogue of a field from its parts, in one order of columns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from astropy import units as u

from ..measurement.catalogue import SHAPES, Flag, describe_flags
from ..measurement.columns import Columns
from ..measurement.photometry import whole_groups
from ..sky.wcs import axis_names, celestial_frame
from .execution.group_results import PATCH_COLUMNS, typed_rows


def finalise_catalogue(job, parts, last, unsettled=(), names=None):
    """The catalogue of the core, sorted by id, and the table of fits, sorted by patch.

    parts: GroupResultsFiles; last: {patch: index of the part with its last round}
    unsettled: parents of blends that were cut into pieces which did not settle
    names {id: name}: of listed sources, for the column `name`; None = without it
    """
    tables, fits = [empty_catalogue(job, named=names is not None)], []
    for i, part in enumerate(parts):
        patches, rows = part.read("PATCHES", "CATALOGUE")
        mine = np.array([last[patch] == i for patch in patches["fit_id"].tolist()], bool)
        tables.append(rows.select_rows(np.repeat(mine, patches["n_sources"])))
        fits.append(patches.select_rows(mine))
    rows = Columns.concatenate(tables)
    whole_groups(rows, job.bands)
    rows["flags"][rows["n_group"] > 1] |= Flag.GROUP
    rows = rows.select_rows(np.argsort(rows["id"], kind="stable"))
    at = np.stack([rows["y"], rows["x"]], axis=1)
    rows = rows.select_rows(job.core.contains(at))
    moving = np.isin(rows["parent_id"], np.array(sorted(unsettled), np.int64))
    reasons = [
        f"{reason}, which had not settled" if one else reason
        for one, reason in zip(moving, rows["reason"].tolist(), strict=True)
    ]
    rows.put("reason", np.array(reasons, "U"))
    if names is not None:
        rows.put("name", np.array([names.get(i, "") for i in rows["id"].tolist()], "U"))
    table = rows.table()
    describe_flags(table)
    blends = Columns.concatenate(fits or [typed_rows([], PATCH_COLUMNS)])
    blends = blends.select_rows(np.argsort(blends["fit_id"])).table()
    for name in blends.colnames:
        blends[name].info.description = PATCH_COLUMNS[name].description
    return table, blends


def empty_catalogue(job, named=False) -> Columns:
    """The columns of a field's catalogue in their order, with units, without rows.

    They follow from the mosaics alone: a band without a single measured flux has its columns.
    """
    grid = job.reference
    sky = ("y_sky", "x_sky") if grid.is_flat else axis_names(grid.wcs)
    places = (*sky, "y", "x")
    names = ["id", *(["name"] if named else []), "parent_id", "group_id", *places]
    names += ["flags", "status", "reason"]
    names += ["n_blend_sources", "n_group", "detection_pass", "detection_snr", "snr"]
    names += ["n_components", *(f"{name}_centroid{end}" for end in ("", "_err") for name in places)]
    names += [f"{name}{end}" for name in SHAPES for end in ("", "_err")]
    channels = [c for mosaic in job.mosaics for c in mosaic.channels]
    calibrated = {c.band or c.name for c in channels if c.zero_point is not None}
    units: dict[str, u.UnitBase] = {}
    for band in job.bands:
        kinds = ("flux", "mag", "group_flux") if band in calibrated else ("flux", "group_flux")
        of_band = [f"{kind}{end}_{band}" for kind in kinds for end in ("", "_err")]
        unit = u.uJy if band in calibrated else u.ct
        units |= {name: unit for name in of_band if not name.startswith("mag")}
        names += of_band
    pairs = [pair for pair in pairwise(job.bands) if calibrated.issuperset(pair)]
    names += [f"colour{end}_{a}_{b}" for a, b in pairs for end in ("", "_err")]
    names += [f"chi2_{mosaic.name}" for mosaic in job.mosaics]
    names += [f"max_residual_{c.name}" for c in channels]
    names += ["misfit_sigma", "misfit_fraction", "ambiguous_with"]
    table = Columns.without_rows(names)
    if not grid.is_flat:
        units |= {f"{name}{end}": u.deg for name in sky for end in ("", "_centroid")}
        units |= {f"{name}_centroid_err": u.deg for name in sky}
        table.meta["FRAME"] = celestial_frame(grid.wcs).name
    table.units |= units
    return table
