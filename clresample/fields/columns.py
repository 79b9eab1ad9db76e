"""The catalogue of a field from its parts, in one order of columns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..measurement.catalogue import describe_flags
from ..measurement.columns import Columns
from ..measurement.photometry import whole_groups
from .execution.group_results import PATCH_COLUMNS, typed_rows

LEADING_COLUMNS = (
    "id",
    "parent_id",
    "group_id",
    "ra",
    "dec",
    "y_sky",
    "x_sky",
    "y",
    "x",
    "flags",
    "status",
    "reason",
)
EMPTY_COLUMNS = "id", "parent_id", "group_id", "y", "x", "flags", "status", "reason"
DETECTION_COLUMNS = ("n_blend_sources", "n_group", "detection_pass", "detection_snr", "snr")


def finalise_catalogue(job, parts, last, unsettled=()):
    """The catalogue of the core, sorted by id, and the table of fits, sorted by patch.

    parts: GroupResultsFiles; last: {patch: index of the part with its last round}
    unsettled: parents of blends that were cut into pieces which did not settle
    """
    tables, fits = [], []
    for i, part in enumerate(parts):
        patches, rows = part.read("PATCHES", "CATALOGUE")
        mine = np.array([last[patch] == i for patch in patches["fit_id"].tolist()], bool)
        tables.append(rows.select_rows(np.repeat(mine, patches["n_sources"])))
        fits.append(patches.select_rows(mine))
    table = Columns.without_rows(EMPTY_COLUMNS).table()
    tables = [rows for rows in tables if len(rows)]
    if tables:
        tables.sort(key=lambda rows: -len(rows.values))  # so that the first one has their order
        rows = Columns.concatenate(tables)
        whole_groups(rows, job.bands)
        rows = rows.select_rows(np.argsort(rows["id"], kind="stable"))
        at = np.stack([rows["y"], rows["x"]], axis=1)
        rows = rows.select_rows(job.core.contains(at))
        moving = np.isin(rows["parent_id"], np.array(sorted(unsettled), np.int64))
        reasons = [
            f"{reason}, which had not settled" if one else reason
            for one, reason in zip(moving, rows["reason"].tolist(), strict=True)
        ]
        rows.put("reason", np.array(reasons, "U"))
        table = rows.table()
    blends = Columns.concatenate(fits or [typed_rows([], PATCH_COLUMNS)])
    blends = blends.select_rows(np.argsort(blends["fit_id"])).table()
    for name in blends.colnames:
        blends[name].info.description = PATCH_COLUMNS[name].description
    if tables:
        table = table[_order(job, table.colnames)]
    describe_flags(table)
    return table, blends


def _order(job, names):
    """Names of columns: ids, status, positions and shapes, then all channels."""
    channels, labels = job.channels, [m.name for m in job.mosaics]
    kinds = "flux", "flux_err", "mag", "mag_err", "group_flux", "group_flux_err"
    fluxes = [f"{key}_{b}" for b in job.bands for key in kinds]
    pairs = list(pairwise(job.bands))
    fluxes += [f"{key}_{a}_{b}" for a, b in pairs for key in ("colour", "colour_err")]
    quality = [f"chi2_{name}" for name in labels] + [f"max_residual_{c}" for c in channels]
    quality += ["misfit_sigma", "misfit_fraction", "ambiguous_with"]
    fixed = [*LEADING_COLUMNS, *DETECTION_COLUMNS]
    middle = [n for n in names if n not in {*fixed, *fluxes, *quality}]
    return [n for n in [*fixed, *middle, *fluxes, *quality] if n in names]
