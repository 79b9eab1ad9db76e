"""Fluxes of a result's sources and their groups: of models, or of data divided among these."""

from __future__ import annotations

import numpy as np
from astropy import units as u

from ..deblending.cutouts.separation import faintest_light, fraction_of, source_image
from ..deblending.posterior.sampling import undetermined
from ..deblending.result import Result
from ..sky.validation.checks import check_instance


def fluxes(result):
    """Fluxes of all sources and their covariances, from the full normal matrix.

        F_s = sum_i A_i |S_i|,  cov(F_s, F_t) = sum_ij |S_i| cov(A_i, A_j) |S_j|,  |S| = sum of S

    over the components i of s and j of t: with morphologies fixed. If the result has Errors, the
    covariances are theirs, marginalised over morphologies. |S| then includes the light of the
    smooth profile beyond its box, below the noise: a percent of the flux at signal to noise 10. The
    bias of F from the bounds of morphologies and spectra at 0 is subtracted, 0.1 to 1 % for bright
    galaxies, so that F is negative for half of the sources without light; F of a faint galaxy is
    its mean over sizes and wings that fit the data. Both are `Errors.flux_correction`.

    result: a fitted blend
    returns flux (S, C) [counts] and covariance (C, S, S) [counts^2]: flux and variance are NaN
        where a channel does not determine a flux, as one whose pixels with weight hold under 5 % of
        the light (0.1 % of a star's), and for sources without components; their covariances with
        others are 0
    """
    check_instance("result", result, Result)
    sums = _light_sums(result)
    flux = sums @ spectra_of(result)
    if result.errors is not None:
        flux = flux + result.errors.flux_correction
    known = np.isfinite(np.diagonal(result.covariance, axis1=1, axis2=2))  # (C, n)
    both = known[:, :, None] & known[:, None, :]
    if result.errors is None:
        summed = sums @ np.where(both, result.covariance, 0.0) @ sums.T
    else:
        summed = result.errors.flux.copy()
    i_source, i_channel = np.nonzero(undetermined(result))
    summed[i_channel, i_source] = summed[i_channel, :, i_source] = 0.0
    summed[i_channel, i_source, i_source] = np.nan
    flux[i_source, i_channel] = np.nan
    return flux, summed


def bounded_fluxes(result):
    """Fluxes (S, C) [counts] of the components, without corrections: none is negative."""
    return _light_sums(result) @ spectra_of(result)


def _light_sums(result):
    """|S| (S, n) of the components of each source, see `fluxes`."""
    sums = np.zeros((len(result.sources), len(result.components)))
    for i, component in enumerate(result.components):
        sums[component.source, i] = component.morphology.sum(dtype=np.float64)
        if result.errors is not None:
            sums[component.source, i] += result.errors.outside_box_moments[i, 0]
    return sums


def channel_covariances(result):
    """Covariances (S, C, C) [counts^2] of each source's fluxes between channels.

    Errors of a morphology change the fluxes of all channels together, so that colours are more
    accurate than fluxes. Without Errors channels are independent. Settings.flux_error_floor is
    included as an error common to all channels. The variance is NaN as in `fluxes`.
    """
    variance = np.diagonal(fluxes(result)[1], axis1=1, axis2=2).T  # (S, C)
    found = np.zeros((*variance.shape, variance.shape[1]))
    if result.errors is not None:
        both = np.isfinite(variance)[:, :, None] & np.isfinite(variance)[:, None, :]
        found = np.where(both, result.errors.colour, 0.0)
    i = np.arange(variance.shape[1])
    found[:, i, i] = variance
    return found


def redistribute(result, i_observation) -> np.ndarray:
    """Each source's share of the observed data: flux re-distribution.

        share_s = (data - sky) max(m_s, 0) / sum_t max(m_t, 0)

    where m_s is the model of s on the observed pixels. The shares of a pixel add up to its data
    without the sky, unless all models are fainter there than 1e-5 of the channel's brightest model
    pixel: then all shares are 0.

    result: a fitted blend; i_observation: number or name of the observation
    returns (S, Co, My, Mx) [counts]: NaN where the data have no weight
    Source: the deblender of SDSS (R. Lupton), with fitted models as its templates.
    """
    check_instance("result", result, Result)
    i_observation = result.index_of(i_observation)
    observation = result.observations[i_observation]
    channels = result.channel_slices()[i_observation]
    whole = tuple(slice(0, n) for n in observation.shape[1:])
    lights = np.zeros((len(result.sources), *observation.shape))
    for source, light in enumerate(lights):
        image = source_image(result, source, i_observation, whole)
        if image is not None:
            np.maximum(image, 0.0, out=light)
    total = lights.sum(axis=0)
    shares = fraction_of(lights, total, faintest_light(total))
    shares *= observation.data - np.asarray(result.sky)[channels, None, None]
    shares[:, observation.weights <= 0] = np.nan
    return shares


def spectra_of(result):
    """Spectra (n, C) [counts] of all n components; (0, C) without any."""
    spectra = [c.spectrum for c in result.components]
    return np.array(spectra, dtype=np.float64).reshape(-1, len(result.channels))


def flux_scale(result):
    """Per channel, the factor from counts to the catalogue's unit, and that unit.

    The unit of the data where all observations have the same one; else uJy, or counts without zero
    points.
    """
    units = {o.unit for o in result.observations}
    shared = units.pop() if len(units) == 1 else None
    scale, unit = [], []
    for o in result.observations:
        one = shared or (u.ct if o.flux_scale is None else u.uJy)
        counts = shared is not None or o.flux_scale is None
        scale += [1.0] * len(o.channels) if counts else list(o.flux_scale)
        unit += [one] * len(o.channels)
    return scale, unit


def group_fluxes(flux, covariance, groups):
    """Total fluxes of groups and their errors, each in the rows of all its members: (S, C) twice.

        F_g = sum_s F_s,   var F_g = sum_st cov(F_s, F_t)   over s, t in g

    flux (S, C), covariance (C, S, S): as `fluxes` returns them; groups (S,): a value for
    each group. Both are NaN where a member has no flux
    """
    _, number = np.unique(np.asarray(groups), return_inverse=True)
    member = np.zeros((number.max(initial=-1) + 1, len(number)))
    member[number, np.arange(len(number))] = 1.0
    known = np.isfinite(flux)
    total = member @ np.where(known, flux, 0.0)
    total[member @ ~known > 0] = np.nan
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    known = np.isfinite(variances)
    summed = np.where(known[:, :, None] & known[:, None, :], covariance, 0.0)
    variance = np.einsum("gs,cst,gt->gc", member, summed, member)
    variance[member @ ~known.T > 0] = np.nan
    return total[number], np.sqrt(np.maximum(variance, 0.0))[number]


def add_groups(table, result, flux, covariance, groups):
    """Columns n_group, group_flux_*, group_flux_err_* of the groups (S,) of a result's sources."""
    _, number, count = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    table.put("n_group", count[number].astype(np.int32))
    total, error = group_fluxes(flux, covariance, groups)
    scale, unit = flux_scale(result)
    for band, i in result.bands.items():
        table.put(f"group_flux_{band}", total[:, i] * scale[i], unit[i])
        table.put(f"group_flux_err_{band}", error[:, i] * scale[i], unit[i])


def whole_groups(rows, bands):
    """Sets the group columns of all fits' Columns as they are in all of them together.

    A group has the id of its brightest member, whichever was detected as its galaxy. Where members
    were fitted apart, its fluxes are the sums of theirs, and errors those without covariance.
    """
    _, number, count = np.unique(rows["group_id"], return_inverse=True, return_counts=True)
    fluxes = (np.nan_to_num(rows[f"flux_{b}"]) for b in bands)
    faintest_first = np.argsort(sum(fluxes, np.zeros(len(number))), kind="stable")
    brightest = np.zeros(len(count), int)
    brightest[number[faintest_first]] = faintest_first
    rows.put("group_id", rows["id"][brightest][number])
    apart = rows["n_group"] != count[number]
    if not apart.any():
        return
    rows["n_group"][apart] = count[number][apart]
    for band in bands:
        total = np.bincount(number, np.asarray(rows[f"flux_{band}"], float))
        variance = np.bincount(number, np.asarray(rows[f"flux_err_{band}"], float) ** 2)
        rows[f"group_flux_{band}"][apart] = total[number][apart]
        rows[f"group_flux_err_{band}"][apart] = np.sqrt(variance)[number][apart]
