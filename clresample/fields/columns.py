"""The catalogue of a field from its parts: one order of columns, units, descriptions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..measurement.catalogue import Flag
from ..measurement.columns import Columns
from ..measurement.photometry import whole_groups
from .execution.group_results import PATCH_COLUMNS

DESCRIPTIONS = {
    "id": "of the source: field, row and column of the model's pixel that holds it",
    "parent_id": "id of the brightest source that was detected in the same blend",
    "group_id": "id of the galaxy whose clump the source may be, or its own",
    "n_group": "sources of the group",
    "flags": "sum of what limits the measurement: "
    + ", ".join(f"{flag.value} {flag.name}" for flag in Flag),
    "status": "how the fit ended",
    "reason": "why it failed, or was cut",
    "n_blend_sources": "sources that were detected in the blend",
    "detection_pass": "1 = detected before the fit, 2 = in its residuals",
    "detection_snr": "signal to noise of the detection, all instruments together",
    "snr": "signal to noise of the fluxes of all channels",
    "y": "row of the detection in the model's pixels, from 0",
    "x": "column of the detection in the model's pixels, from 0",
    "ra": "right ascension of the detection",
    "dec": "declination of the detection",
    "y_sky": "of the detection on the flat sky",
    "x_sky": "of the detection on the flat sky",
    "n_components": "of the source's model: 2 where its core has another colour",
    "rms_size": "of the fitted light under the model's PSF: root of the mean of its second moments",
    "e1": "ellipticity of the fitted light: above 0 where it is stretched north - south",
    "e2": "ellipticity of the fitted light: above 0 where it is stretched north-east - south-west",
    "position_angle": "of the fitted light's long axis, east of north",
    "misfit_sigma": "largest residual, or excess of chi2, of the source in any channel, in sigma",
    "misfit_fraction": "light that the model leaves over the flux, 0 where it is under 5 sigma",
    "ambiguous_with": "id of the source whose light this one's may be, -1 without any",
}
FIT_COLUMNS = {  # of fit_table.ecsv
    "fit_id": "number of the fit",
    "parent_id": "id of the brightest source that was detected in the blend",
    "n_refits": "how often a piece of a cut blend was fitted again",
    "status": "how the fit ended",
    "n_sources": "that were fitted together",
    "n_pixels": "of the model, about the blend",
    "n_iterations": "of the fit",
    "seconds": "of the fit, its share of a group's",
}
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
# of a field without a source
EMPTY = {
    "id": np.zeros(0, np.int64),
    "parent_id": np.zeros(0, np.int64),
    "group_id": np.zeros(0, np.int64),
    "y": np.zeros(0) * u.pix,
    "x": np.zeros(0) * u.pix,
    "flags": np.zeros(0, np.int32),
    "status": np.zeros(0, "U1"),
    "reason": np.zeros(0, "U1"),
}
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
    table = QTable({name: EMPTY[name].copy() for name in LEADING_COLUMNS if name in EMPTY})
    tables = [rows for rows in tables if len(rows)]
    if tables:
        tables.sort(key=lambda rows: -len(rows.values))  # so that the first one has their order
        rows = Columns.concatenate(tables)
        whole_groups(rows, job.bands)
        table = rows.select_rows(np.argsort(rows["id"], kind="stable")).table()
        at = np.stack([table["y"].value, table["x"].value], axis=1)
        table = table[job.core.contains(at)]
        moving = np.isin(table["parent_id"], np.array(sorted(unsettled), np.int64))
        table["reason"] = [
            f"{reason}, which had not settled" if one else str(reason)
            for one, reason in zip(moving, table["reason"], strict=True)
        ]
    empty = Columns({name: np.zeros(0, kind) for name, kind in PATCH_COLUMNS.items()})
    blends = Columns.concatenate(fits or [empty])
    blends = blends.select_rows(np.argsort(blends["fit_id"])).table()
    blends["seconds"] = blends["seconds"] * u.s
    for name in set(FIT_COLUMNS) & set(blends.colnames):
        blends[name].info.description = FIT_COLUMNS[name]
    return _described(table[_order(job, table.colnames)] if tables else table), blends


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


def _described(table):
    """The table with descriptions of its columns."""
    for name in table.colnames:
        table[name].info.description = DESCRIPTIONS.get(name) or _description(name)
    return table


def _description(name):
    """Description of a column whose name holds a channel or an instrument, or an error's."""
    for prefix, text in (
        ("group_flux_err_", "error of the flux of all of the group in {}"),
        ("group_flux_", "flux of all of the group in {}"),
        ("flux_err_", "error of the flux in {}"),
        ("flux_", "total flux in {}"),
        ("mag_err_", "error of the magnitude in {}"),
        ("mag_", "AB magnitude of the total flux in {}"),
        ("colour_err_", "error of the colour of {}"),
        ("colour_", "AB magnitude in the first band minus that in the second, of {}"),
        ("chi2_", "mean chi2 of the source's pixels in {}"),
        ("max_residual_", "largest residual on the source in {}, in sigma"),
    ):
        if name.startswith(prefix):
            return text.format(name.removeprefix(prefix))
    if name.endswith("_err"):
        return f"error of {name.removesuffix('_err')}"
    if name.endswith("_centroid"):
        return f"{name.removesuffix('_centroid')} of the fitted light's centroid"
    return None
