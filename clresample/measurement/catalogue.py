"""Converts a fitted model to a catalogue: fluxes, errors, positions, shapes, chi2 and flags."""

from __future__ import annotations

from enum import IntFlag
from itertools import pairwise

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..deblending.assessment.ambiguity import partners
from ..deblending.assessment.edge import reaches_outside
from ..deblending.assessment.status import misfitted_sources
from ..deblending.assessment.unlisted import beside_unlisted_light
from ..deblending.assessment.unsettled import unsettled_sources
from ..deblending.inspection.listing import doubles
from ..deblending.posterior.residuals import channel_residuals
from ..deblending.result import Result
from ..sky.footprint import coverage_border
from ..sky.observation import ZERO_POINT_UJY
from ..sky.sources import group_rows
from ..sky.validation.checks import check_instance
from ..sky.wcs import axis_names, celestial_frame, local_axes
from .columns import Columns, definition
from .photometry import add_groups, bounded_fluxes, channel_covariances, flux_scale, fluxes
from .quality import box_chi2, fitted_sources, masked_cores, observation_labels
from .shapes import moments, shape, shape_slopes

# [1] Light at the edge of the observed area is flagged if it exceeds this fraction of a
# morphology's peak. Fainter light changes fluxes by at most a few percent; a lower limit flags
# noise in the wings.
EDGE_LIGHT = 0.01

# [deg] Scatter of a uniformly distributed angle: the largest possible error.
UNKNOWN_ANGLE_DEG = 180 / np.sqrt(12)
SHAPES = "rms_size", "e1", "e2", "position_angle"


class Flag(IntFlag):
    """Limits of a source's measurement.

    `flags` of a catalogue are sums of these (FLAG_MEANINGS).
    """

    EDGE = 1
    NOT_CONVERGED = 2
    ZERO_FLUX = 4
    NO_COVERAGE = 8
    OUTSIDE_FRAME = 16
    CENTER_MASKED = 32
    MISFIT = 64
    SATURATED = 128
    AMBIGUOUS = 256
    GROUP = 512
    UNLISTED = 1024

    @classmethod
    def _missing_(cls, value):
        return super()._missing_(int(value))  # tables hold NumPy's integers, enum takes Python's


# Meaning of each Flag in words.
FLAG_MEANINGS = {
    Flag.EDGE: "at the frame's edge or beside unobserved sky over 1 % of a morphology's peak, or "
    "over 3 % of the flux outside, as the model goes on there",
    Flag.NOT_CONVERGED: "the blend's fit did not converge, and this flux changed by over 0.2 of "
    "its error in the last half of the iterations, by an unknown part, or at a wrong model",
    Flag.ZERO_FLUX: "the flux in a channel that determines it is at its limit, zero",
    Flag.NO_COVERAGE: "a channel's image does not hold the centre, or hardly any of the light",
    Flag.OUTSIDE_FRAME: "outside the frame, thus not fitted: nothing is measured",
    Flag.CENTER_MASKED: "the centre is on a pixel without weight in a channel whose image holds it",
    Flag.SATURATED: "a star with masked pixels in its core, a bright source with half of it masked",
    Flag.MISFIT: "the model leaves over 5 sigma (4 beside a point) and over 3 % of the flux",
    Flag.AMBIGUOUS: "the data do not tell its light from that of the source in ambiguous_with",
    Flag.GROUP: "one of several sources that may be pieces of one galaxy: group_flux_* is of all",
    Flag.UNLISTED: "its model, or one that overlaps it, holds the light of a peak without a source",
}


def catalogue(result, *, magnitudes=True, groups=None) -> QTable:
    """The catalogue of a fitted blend: one row per source, columns with units.

    result: a fitted blend; magnitudes: add the columns of magnitudes and colours of bands that have
        zero points
    groups (S,): a number for each group of sources, as `Detection.groups`; None = by the `group` of
        the sources, if any is in one
    returns QTable (S rows, in the order of `result.sources`); what was not measured is NaN:
        name: the source's own, or its number
        ra, dec [deg], or what the frame's WCS calls them; y_sky, x_sky [arcsec] on a flat sky; and
            y, x [model px]: position as given
        flags: sum of `Flag`
        snr: signal to noise of all B bands together, negative fluxes as 0,
            sqrt(sum_b max(flux_b, 0)^2 / variance_b); about sqrt(B / 2) without a source
        n_components: number of components; two if the core has a significantly different colour,
            or lies in far wider light, see `ExtendedSource`
        *_centroid: the same positions, of the fitted light
        rms_size [arcsec], e1, e2, position_angle [deg]: see `shapes.shape`. They are those of the
            model under the model's PSF, not deconvolved. A source's components are weighted by
            their flux in all channels, each in units of its error. If the result has Errors, the
            light of the smooth profile beyond its box is included, and the bias from the bound of
            morphologies at 0 is subtracted, see `Errors.moment_bound_bias`
        *_centroid_err, rms_size_err, e1_err, e2_err, position_angle_err: errors in the units of the
            values, to first order; ra's in degrees of ra, position_angle_err at most 52 deg, that
            of an unknown angle. NaN if the result has no Errors, or if the shape was not fitted, as
            for stars. They, and those of fluxes, are larger for misfitted sources, see `Errors`
        flux_*, flux_err_* per band, or per channel if the observation has no `bands`; the
            exposures of a band have one flux, see `fluxes`. The unit is that of the data if all
            observations have the same, else uJy if they have zero points, else counts. NaN if the
            band's pixels with weight hold under 5 % of the light (0.1 % of a star's)
        mag_*, mag_err_* per band [mag, AB]: where the flux is positive
        colour_A_B, colour_err_A_B [mag]: mag_A - mag_B of neighbouring bands A and B; the error
            follows from the covariance of the two fluxes to first order, see
            `channel_covariances`, and is valid if both are detected
        group_id, n_group: number of the group (of its first row, where sources have it), and its
            sources; group_flux_*, group_flux_err_* per channel: of all of them together, the error
            with the covariances of their fluxes. Without groups there are no such columns
        chi2_* per observation: mean chi2 of the pixels with weight in the source's box, of all
            channels and with all sources' models
        max_residual_* per channel [sigma]: the largest residual on the source once filtered with
            the PSF, see `residuals.max_filtered_residuals`
        misfit_sigma [sigma]: the largest of these residuals, of the excess of chi2 of the source's
            pixels in a channel, and of the light about a point that is wider than the PSF
        misfit_fraction [1]: residual light over flux, in the channel with the largest ratio of
            those over 5 sigma, of wider light over 4; 0 if there is none. A source over that and
            over 0.03 is flagged MISFIT, see `Misfit`
        ambiguous_with: row of the source whose light cannot be told apart from this source's, see
            `is_ambiguous`; -1 if there is none
    """
    check_instance("result", result, Result)
    expected = (len(result.sources),)
    if groups is not None and np.shape(groups) != expected:
        raise ValueError(
            f"groups has the shape {np.shape(groups)}, must be {expected}: give a number for each "
            "source, as Detection.groups"
        )
    table = catalogue_columns(result, magnitudes=magnitudes, groups=groups).table()
    describe_flags(table)
    return table


def describe_flags(table):
    """Adds the names of all flags to the description of a table's column `flags`."""
    names = ", ".join(f"{flag.value} {flag.name}" for flag in Flag)
    table["flags"].info.description = f"{definition('flags').description}: {names}"


def catalogue_columns(result, *, magnitudes=True, groups=None, bands=None) -> Columns:
    """The same as `catalogue`, before it is a table.

    bands: names in the order whose neighbours form colours; None = as in the result
    """
    worst, misfit = channel_residuals(result), result.misfit
    flux, covariance = fluxes(result)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)  # (S, C)
    of_bands = list(result.bands.values())
    table = Columns()
    table.put("name", [s.name or str(i) for i, s in enumerate(result.sources)])
    positions = result.frame.positions_of(result.sources)
    add_positions(table, result.frame.grid, positions, "")
    bounded = np.where(np.isfinite(error), bounded_fluxes(result), np.nan)
    table.put("flags", _flags(result, bounded, error, positions, result.footprints))
    fitted = fitted_sources(result)
    with np.errstate(divide="ignore", invalid="ignore"):
        positive = np.maximum(flux / error, 0)[:, of_bands]
        snr = np.sqrt(np.nansum(positive**2, axis=1))
    table.put("snr", np.where(fitted, snr, np.nan))
    table.put("n_components", _counts(result))
    once = np.isin(np.arange(len(result.channels)), of_bands)  # exposures of a band count once
    _add_shapes(table, result, np.where(once, error, np.inf))
    scale, unit = flux_scale(result)
    for band, i in result.bands.items():
        table.put(f"flux_{band}", flux[:, i] * scale[i], unit[i])
        table.put(f"flux_err_{band}", error[:, i] * scale[i], unit[i])
        if magnitudes and unit[i] != u.ct:
            to_ujy = scale[i] * unit[i].to(u.uJy)
            _add_magnitudes(table, band, flux[:, i] * to_ujy, error[:, i] * to_ujy)
    if magnitudes:
        _add_colours(table, result, flux, bands or list(result.bands))
    own_groups = groups is None and any(s.group is not None for s in result.sources)
    if own_groups:
        groups = group_rows(result.sources)
    if groups is not None:
        table.put("group_id", np.asarray(groups))
        add_groups(table, result, flux, covariance, groups)
    if own_groups:
        table["flags"][table["n_group"] > 1] |= Flag.GROUP
    for i, label in enumerate(observation_labels(result)):
        table.put(f"chi2_{label}", box_chi2(result, i, result.footprints[i]))
    for channel, values in zip(result.channels, worst.T, strict=True):
        table.put(f"max_residual_{channel}", values)
    table.put("misfit_sigma", np.where(fitted, misfit.sigma().max(axis=1, initial=0), np.nan))
    table.put("misfit_fraction", np.where(fitted, misfit.fraction(), np.nan))
    table["flags"][misfitted_sources(result)] |= Flag.MISFIT
    _add_partners(table, result, flux, covariance)
    return table


def _add_partners(table, result, flux, covariance):
    """Adds the column of ambiguous sources' partners and their flag.

    Sources at one place, which a message names, are each other's where they have no other one.
    Only results with Errors have them, because at fixed morphologies fluxes are not ambiguous.
    """
    found = np.full(len(flux), -1)
    if result.errors is not None:
        found = partners(flux, covariance)
        for pair in doubles(result.sources, result.frame.positions_of(result.sources)):
            for one, other in (pair, pair[::-1]):
                found[one] = other if found[one] < 0 else found[one]
    table.put("ambiguous_with", found)
    table["flags"][found >= 0] |= Flag.AMBIGUOUS


def _counts(result):
    """Components (S,) of each source."""
    owner = np.array([c.source for c in result.components], int)
    return np.bincount(owner, minlength=len(result.sources))


def add_positions(table, grid, positions, suffix):
    """Columns of (S, 2) [model px], also on the sky."""
    sky = grid.sky(*positions.T)
    names, unit = ("y_sky", "x_sky"), u.arcsec
    if not grid.is_flat:
        names, unit = axis_names(grid.wcs), u.deg
        table.meta["frame"] = celestial_frame(grid.wcs).name
    for name, values in zip(names, sky, strict=True):
        table.put(name + suffix, values, unit)
    for name, values in zip("yx", positions.T, strict=True):
        table.put(name + suffix, values)


def _add_shapes(table, result, error):
    """Columns of centroids and second moments, (S, C) errors weighting a source's channels."""
    n_sources = len(result.sources)
    centroids, sizes = np.full((n_sources, 2), np.nan), np.full((n_sources, 4), np.nan)
    shape_errors = sizes.copy()
    for s in np.flatnonzero(fitted_sources(result)):
        own = [i for i, c in enumerate(result.components) if c.source == s]
        parts = [result.components[i] for i in own]
        beyond = None if result.errors is None else result.errors.outside_box_moments[own]
        good = np.isfinite(error[s]) & (error[s] > 0)
        weight = np.where(good, 1 / np.where(good, error[s], 1.0), 0.0)
        light = np.array([weight @ c.flux for c in parts])
        centroids[s], second = moments(parts, light, beyond)
        if result.errors is not None:
            centroids[s], second = _released(
                centroids[s], second, result.errors.moment_bound_bias[s]
            )
        if np.isfinite(centroids[s]).all():
            axes = local_axes(result.frame.grid, centroids[s])
            sizes[s] = shape(axes @ second @ axes.T)
            if result.errors is not None:
                moved = shape_slopes(second, axes)
                shape_errors[s] = _scatter(moved, result.errors.moments[s, 2:, 2:])
    add_positions(table, result.frame.grid, centroids, "_centroid")
    _add_position_errors(table, result, centroids)
    shape_errors[:, 3] = np.minimum(shape_errors[:, 3], UNKNOWN_ANGLE_DEG)
    for i, name in enumerate(SHAPES):
        table.put(name, sizes[:, i])
        table.put(f"{name}_err", shape_errors[:, i])


def _released(centroid, second, moved):
    """A centroid (2,) and second moments (2, 2) plus the correction `moved` (5,), see Errors.

    They are unchanged if the second moments would not be positive definite, as can happen for
    noise.
    """
    yy, yx, xx = moved[2:]
    changed = second + [[yy, yx], [yx, xx]]
    if not (np.linalg.det(changed) > 0 and np.trace(changed) > 0):
        return centroid, second
    return centroid + moved[:2], changed


def _scatter(slopes, covariance):
    """Errors (n,) of quantities with slopes (n, k) by variables of covariance (k, k)."""
    return np.sqrt(np.einsum("nk,kl,nl->n", slopes, covariance, slopes))


def _add_position_errors(table, result, centroids):
    """Columns of the errors of the fitted light's centroids (S, 2) [model px]."""
    grid = result.frame.grid
    names = ("y_sky", "x_sky") if grid.is_flat else list(table.values)[1:3]
    on_sky, errors = np.full((2, *centroids.shape), np.nan)
    for s in np.flatnonzero(np.isfinite(centroids).all(1) & (result.errors is not None)):
        covariance = result.errors.moments[s, :2, :2]
        n, m = centroids[s, :, None] + [[0.5, -0.5, 0, 0], [0, 0, 0.5, -0.5]]
        sky = np.array(grid.sky(n, m))
        steps = np.stack([sky[:, 0] - sky[:, 1], sky[:, 2] - sky[:, 3]], axis=1)
        if not grid.is_flat:  # right ascensions next to 0
            steps[0] = (steps[0] + 180) % 360 - 180
        errors[s] = np.sqrt(np.diag(covariance))
        on_sky[s] = _scatter(steps, covariance)
    unit = u.arcsec if grid.is_flat else u.deg
    for i, name in enumerate(names):
        table.put(f"{name}_centroid_err", on_sky[:, i], unit)
    for i, name in enumerate("yx"):
        table.put(f"{name}_centroid_err", errors[:, i])


def _add_magnitudes(table, channel, flux_ujy, error_ujy):
    flux_ujy = np.where(flux_ujy > 0, flux_ujy, np.nan)
    table.put(f"mag_{channel}", ZERO_POINT_UJY - 2.5 * np.log10(flux_ujy))
    table.put(f"mag_err_{channel}", 2.5 / np.log(10) * error_ujy / flux_ujy)


def _add_colours(table, result, flux, bands):
    """Columns of colours of neighbouring bands that have magnitudes; flux (S, C)."""
    covariance = channel_covariances(result)
    for a, b in pairwise(bands):
        if f"mag_{a}" not in table or f"mag_{b}" not in table:
            continue
        pair = [result.bands[a], result.bands[b]]
        one, other = (np.where(flux[:, k] > 0, flux[:, k], np.nan) for k in pair)
        slopes = np.stack([1 / one, -1 / other], axis=1)  # of ln(flux ratio)
        both = covariance[:, pair][:, :, pair]
        error = np.sqrt(np.einsum("sa,sab,sb->s", slopes, both, slopes))
        table.put(f"colour_{a}_{b}", table[f"mag_{a}"] - table[f"mag_{b}"])
        table.put(f"colour_err_{a}_{b}", 2.5 / np.log(10) * error)


def _flags(result, flux, error, positions, footprints):
    """Bit masks (S,) of `Flag`; flux (S, C): of the components, at their bound or above."""
    fitted = fitted_sources(result)
    flags = np.zeros(len(fitted), dtype=np.int32)
    flags[unsettled_sources(result)] |= Flag.NOT_CONVERGED
    flags[~fitted] |= Flag.OUTSIDE_FRAME
    flags[((flux <= 0) & np.isfinite(error)).any(axis=1)] |= Flag.ZERO_FLUX
    flags[fitted & ~np.isfinite(error).all(axis=1)] |= Flag.NO_COVERAGE
    for footprint in footprints:
        held = footprint.contains(positions)
        flags[fitted & ~held] |= Flag.NO_COVERAGE
        flags[fitted & held & ~footprint.weighted(positions).all(axis=0)] |= Flag.CENTER_MASKED
    flags[masked_cores(result, positions)] |= Flag.SATURATED
    flags[reaches_outside(result, flux)] |= Flag.EDGE
    flags[beside_unlisted_light(result)] |= Flag.UNLISTED
    edge = coverage_border(result.unobserved)
    for c in result.components:
        (y, x), (n_y, n_x) = c.origin, c.morphology.shape
        bright = c.morphology > EDGE_LIGHT * c.morphology.max(initial=0.0)
        if (bright & edge[y : y + n_y, x : x + n_x]).any():
            flags[c.source] |= Flag.EDGE
    return flags
