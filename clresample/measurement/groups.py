"""Fluxes of groups: a large galaxy with the sources in its light that may be clumps of it."""

from __future__ import annotations

import numpy as np

from .photometry import flux_scale


def group_fluxes(flux, covariance, groups):
    """Total fluxes of groups and their errors, each in the rows of all its members: (S, C) twice.

        F_g = sum_s F_s,   var F_g = sum_st cov(F_s, F_t)   over s, t in g

    flux (S, C), covariance (C, S, S): as `photometry.fluxes` returns them; groups (S,): a value for
    each group. Of members without a flux, whose variance is infinite, none is added: the error is
    infinite too
    """
    _, number = np.unique(np.asarray(groups), return_inverse=True)
    member = np.zeros((number.max(initial=-1) + 1, len(number)))
    member[number, np.arange(len(number))] = 1.0
    total = member @ np.where(np.isfinite(flux), flux, 0.0)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    known = np.isfinite(variances)
    summed = np.where(known[:, :, None] & known[:, None, :], covariance, 0.0)
    variance = np.einsum("gs,cst,gt->gc", member, summed, member)
    variance[member @ ~known.T > 0] = np.inf
    return total[number], np.sqrt(np.maximum(variance, 0.0))[number]


def add_groups(table, result, flux, covariance, groups):
    """Columns n_group, group_flux_*, group_flux_err_* of the groups (S,) of a result's sources."""
    _, number, count = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    table.put("n_group", count[number].astype(np.int32))
    total, error = group_fluxes(flux, covariance, groups)
    scale, unit = flux_scale(result)
    for i, channel in enumerate(result.channels):
        table.put(f"group_flux_{channel}", total[:, i] * scale[i], unit[i])
        table.put(f"group_flux_err_{channel}", error[:, i] * scale[i], unit[i])


def whole_groups(rows, channels):
    """Groups whose members were fitted apart, in Columns of all fits: in place.

    Their fluxes are the sums of their members', their errors those of members without covariance.
    """
    _, number, count = np.unique(rows["group_id"], return_inverse=True, return_counts=True)
    apart = rows["n_group"] != count[number]
    if not apart.any():
        return
    rows["n_group"][apart] = count[number][apart]
    for channel in channels:
        if f"flux_{channel}" not in rows:
            continue
        total = np.bincount(number, np.nan_to_num(rows[f"flux_{channel}"]))
        variance = np.bincount(number, np.asarray(rows[f"flux_err_{channel}"], float) ** 2)
        rows[f"group_flux_{channel}"][apart] = total[number][apart]
        rows[f"group_flux_err_{channel}"][apart] = np.sqrt(variance)[number][apart]
