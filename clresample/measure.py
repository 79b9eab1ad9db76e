"""A fitted model turned into a catalogue: fluxes with errors, positions, shapes, chi2 and flags."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from astropy import units as u
from astropy.table import QTable
from astropy.wcs.utils import wcs_to_celestial_frame

from .footprint import Footprint, open_edge
from .observation import ZERO_POINT_UJY
from .shapes import local_axes, moments, shape

# of a morphology's peak: fainter light at the edge of what was seen makes no flux wrong by more
# than a few percent, and noise in the wings of bright sources stays under it
EDGE_LIGHT = 0.01
# of a channel's brightest model pixel: under it, rounding of float32 renderings (1e-6), not light,
# decides which source a pixel belongs to
TRACE = 1e-5


class Flag(IntFlag):
    """What is remarkable about a source: a catalogue's `flags` are sums of these (MEANINGS)."""

    EDGE = 1
    NOT_CONVERGED = 2
    ZERO_FLUX = 4
    NO_COVERAGE = 8
    OUTSIDE = 16
    MASKED = 32

    @classmethod
    def _missing_(cls, value):
        return super()._missing_(int(value))  # tables hold NumPy's whole numbers, enum takes int


MEANINGS = {
    Flag.EDGE: "over 1 % of a morphology's peak at the frame's edge, or beside sky that none saw",
    Flag.NOT_CONVERGED: "the blend's fit ended for another reason than convergence",
    Flag.ZERO_FLUX: "the flux in a channel that determines it is at its limit, zero",
    Flag.NO_COVERAGE: "a channel's image does not hold the centre, or determines no flux",
    Flag.OUTSIDE: "outside the frame, thus not fitted: nothing is measured",
    Flag.MASKED: "the centre is on a pixel without weight in a channel whose image holds it",
}


def fluxes(result):
    """Fluxes of all sources and their covariances, from the full normal matrix.

        F_s = sum_i A_i |S_i|,  cov(F_s, F_t) = sum_ij |S_i| cov(A_i, A_j) |S_j|,  |S| = sum of S

    over the components i of s and j of t.

    returns flux (S, C) [counts]: NaN for a source without components; covariance (C, S, S)
        [counts^2]: the variance is infinite where a channel does not determine a flux, and for
        sources without components
    """
    sums = np.zeros((len(result.sources), len(result.components)))
    for i, component in enumerate(result.components):
        sums[component.source, i] = component.morphology.sum(dtype=np.float64)
    flux = sums @ _spectra(result)
    flux[~_fitted(result)] = np.nan
    known = np.isfinite(np.diagonal(result.covariance, axis1=1, axis2=2))  # (C, n)
    both = known[:, :, None] & known[:, None, :]
    summed = sums @ np.where(both, result.covariance, 0.0) @ sums.T
    # a component that is zero everywhere adds nothing, not even ignorance
    lost = (~known) @ (sums != 0).T | ~_fitted(result)
    i_channel, i_source = np.nonzero(lost)
    summed[i_channel, i_source] = summed[i_channel, :, i_source] = 0.0
    summed[i_channel, i_source, i_source] = np.inf
    return flux, summed


def catalogue(result, *, magnitudes=False) -> QTable:
    """One row per source, in the order of `result.sources`, with units.

    name; position as given: on the sky (`ra`, `dec` or what the frame's WCS calls them [deg];
    `y_sky`, `x_sky` [arcsec] if flat) and `y`, `x` [model px]; flags: sums of `Flag`; snr: signal
    to noise of all channels together,

        snr = sqrt( sum_c flux_c^2 / variance_c ),     about sqrt(C) for no source at all

    y_centroid, x_centroid and the same on the sky; size, e1, e2, angle: see `shapes.shape`, those
    of the model under the model's PSF, not deconvolved, components weighted by their flux (of all
    channels, each in units of its error); per channel flux_* and flux_err_* [uJy where observations
    have zero points, else counts], errors from `fluxes`, and with `magnitudes` also mag_* and
    mag_err_* (AB) of positive fluxes; per observation chi2_*: chi2 per pixel with weight on the
    source's box, all its channels and all sources' models together. NaN is: not measured.
    """
    flux, covariance = fluxes(result)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)  # (S, C)
    footprints = [Footprint.of(result, i) for i in range(len(result.observations))]
    table = QTable()
    table["name"] = [s.name or str(i) for i, s in enumerate(result.sources)]
    positions = result.frame.place(result.sources)
    _add_positions(table, result.frame.grid, positions, "")
    table["flags"] = _flags(result, flux, error, positions, footprints)
    table["flags"].info.description = ", ".join(f"{flag.value} {flag.name}" for flag in Flag)
    with np.errstate(divide="ignore", invalid="ignore"):
        table["snr"] = np.sqrt(np.nansum((flux / error) ** 2, axis=1))
    table["snr"][~_fitted(result)] = np.nan
    _add_shapes(table, result, error)
    scale, unit = _scale(result)
    for i, channel in enumerate(result.channels):
        table[f"flux_{channel}"] = flux[:, i] * scale[i] * unit[i]
        table[f"flux_err_{channel}"] = error[:, i] * scale[i] * unit[i]
        if magnitudes and unit[i] == u.uJy:
            _add_magnitudes(table, channel, flux[:, i] * scale[i], error[:, i] * scale[i])
    for i, label in enumerate(labels(result)):
        table[f"chi2_{label}"] = _box_chi2(result, i, footprints[i])
    return table


def summary(result) -> dict:
    """What became of the blend as a whole, in plain values that JSON can hold.

    status, messages, seconds as in `Result`; n_sources, n_fitted (inside the frame), n_components,
    n_iterations, losses; chi2 {channel: per pixel with a weight on the frame, NaN without any},
    n_pixels {channel}, sky {channel} [counts], shifts {observation: (y, x) [model px]}
    """
    chi2, n_pixels = {}, {}
    for i, observation in enumerate(result.observations):
        used = Footprint.of(result, i).used
        terms = _chi2_terms(result, i, used)
        for channel, one, where in zip(observation.channels, terms, used, strict=True):
            n_pixels[channel] = int(where.sum())
            chi2[channel] = float(one[where].mean()) if where.any() else float("nan")
    return {
        "status": result.status,
        "messages": list(result.messages),
        "n_sources": len(result.sources),
        "n_fitted": int(_fitted(result).sum()),
        "n_components": len(result.components),
        "n_iterations": max(len(result.losses) - 1, 0),
        "losses": [float(loss) for loss in result.losses],
        "chi2": chi2,
        "n_pixels": n_pixels,
        "sky": dict(zip(result.channels, map(float, result.sky), strict=True)),
        "shifts": {
            label: [float(s) for s in shift]
            for label, shift in zip(labels(result), result.shifts, strict=True)
        },
        "seconds": {stage: float(t) for stage, t in result.seconds.items()},
    }


def redistribute(result, i_observation) -> np.ndarray:
    """Each source's share of the observed data: flux re-distribution.

        share_s = (data - sky) max(m_s, 0) / sum_t max(m_t, 0)

    m_s being the model of s on the observed pixels. The shares of a pixel add up to its data
    without the sky, unless all models are fainter there than 1e-5 of the channel's brightest model
    pixel: such pixels are nobody's, and all shares are 0.

    returns (S, Co, My, Mx) [counts]: NaN where the data have no weight
    Source: the deblender of SDSS (R. Lupton), with fitted models as its templates.
    """
    observation = result.observations[i_observation]
    channels = result.channel_slices()[i_observation]
    shares = np.zeros((len(result.sources), *observation.data.shape))
    spectra = _spectra(result)[:, channels]
    for i, component in enumerate(result.components):
        shares[component.source] += spectra[i, :, None, None] * result.rendered[i_observation][i]
    np.maximum(shares, 0.0, out=shares)
    total = shares.sum(axis=0)
    lit = total > TRACE * total.max(axis=(1, 2), keepdims=True)
    ratio = np.zeros_like(total)
    data = observation.data - np.asarray(result.sky)[channels, None, None]
    np.divide(data, total, out=ratio, where=lit)
    shares *= ratio
    shares[:, observation.weights <= 0] = np.nan
    return shares


def labels(result) -> list[str]:
    """A name for each observation, unique: its own, numbered where it has none or shares it."""
    names = [o.name or "observation" for o in result.observations]
    return [
        name if names.count(name) == 1 and o.name else f"{name}{i}"
        for i, (name, o) in enumerate(zip(names, result.observations, strict=True))
    ]


def _fitted(result):
    """Which sources (S,) have a component."""
    fitted = np.zeros(len(result.sources), dtype=bool)
    fitted[[c.source for c in result.components]] = True
    return fitted


def _spectra(result):
    """(n, C) [counts]; no components are (0, C)."""
    spectra = [c.spectrum for c in result.components]
    return np.array(spectra, dtype=np.float64).reshape(-1, len(result.channels))


def _scale(result):
    """Per channel, what turns counts into the catalogue's unit, and that unit."""
    scale, unit = [], []
    for o in result.observations:
        given = o.flux_scale is not None
        scale += list(o.flux_scale) if given else [1.0] * len(o.channels)
        unit += [u.uJy if given else u.ct] * len(o.channels)
    return scale, unit


def _add_positions(table, grid, positions, suffix):
    """Columns of (S, 2) [model px], also on the sky."""
    sky = grid.sky(*positions.T)
    names, unit = ("y_sky", "x_sky"), u.arcsec
    if grid.wcs is not None:
        names, unit = (grid.wcs.wcs.lngtyp.lower(), grid.wcs.wcs.lattyp.lower()), u.deg
        table.meta["frame"] = wcs_to_celestial_frame(grid.wcs).name
    for name, values in zip(names, sky, strict=True):
        table[name + suffix] = values * unit
    for name, values in zip("yx", positions.T, strict=True):
        table[name + suffix] = values * u.pix


def _add_shapes(table, result, error):
    """Columns of centroids and second moments, (S, C) errors weighting a source's channels."""
    n_sources = len(result.sources)
    centroids, sizes = np.full((n_sources, 2), np.nan), np.full((n_sources, 4), np.nan)
    for s in np.flatnonzero(_fitted(result)):
        parts = [c for c in result.components if c.source == s]
        good = np.isfinite(error[s]) & (error[s] > 0)
        weight = np.where(good, 1 / np.where(good, error[s], 1.0), 0.0)
        light = np.array([weight @ c.flux for c in parts])
        centroids[s], second = moments(parts, light)
        if np.isfinite(centroids[s]).all():
            axes = local_axes(result.frame.grid, centroids[s])
            sizes[s] = shape(axes @ second @ axes.T)
    _add_positions(table, result.frame.grid, centroids, "_centroid")
    table["size"] = sizes[:, 0] * u.arcsec
    table["e1"], table["e2"] = sizes[:, 1], sizes[:, 2]
    table["angle"] = sizes[:, 3] * u.deg


def _add_magnitudes(table, channel, flux_ujy, error_ujy):
    flux_ujy = np.where(flux_ujy > 0, flux_ujy, np.nan)
    table[f"mag_{channel}"] = (ZERO_POINT_UJY - 2.5 * np.log10(flux_ujy)) * u.mag
    table[f"mag_err_{channel}"] = 2.5 / np.log(10) * error_ujy / flux_ujy * u.mag


def _chi2_terms(result, i_observation, used):
    """Weighted squared residuals (Co, My, Mx), 0 where not used."""
    o = result.observations[i_observation]
    if result.components:
        residual = o.data - result.model(i_observation)
    else:
        channels = result.channel_slices()[i_observation]
        residual = o.data - np.asarray(result.sky)[channels, None, None]
    return np.where(used, o.weights * residual**2, 0.0)


def _box_chi2(result, i_observation, footprint):
    """Chi2 per pixel (S,) on the pixels whose centre lies in a box of the source."""
    terms = _chi2_terms(result, i_observation, footprint.used).sum(axis=0)
    counts = footprint.used.sum(axis=0)
    y, x = np.moveaxis(footprint.positions, -1, 0)
    chi2 = np.full(len(result.sources), np.nan)
    for s in range(len(result.sources)):
        inside = np.zeros(counts.shape, dtype=bool)
        for c in result.components:
            if c.source == s:
                (y0, x0), (n_y, n_x) = np.array(c.origin) - 0.5, c.morphology.shape
                inside |= (y >= y0) & (y < y0 + n_y) & (x >= x0) & (x < x0 + n_x)
        n = counts[inside].sum()
        if n:
            chi2[s] = terms[inside].sum() / n
    return chi2


def _flags(result, flux, error, positions, footprints):
    """Bit masks (S,) of `Flag`."""
    fitted = _fitted(result)
    flags = np.zeros(len(fitted), dtype=np.int32)
    if result.status != "converged":
        flags |= Flag.NOT_CONVERGED
    flags[~fitted] |= Flag.OUTSIDE
    flags[((flux <= 0) & np.isfinite(error)).any(axis=1)] |= Flag.ZERO_FLUX
    flags[fitted & ~np.isfinite(error).all(axis=1)] |= Flag.NO_COVERAGE
    for footprint in footprints:
        held = footprint.holds(positions)
        flags[fitted & ~held] |= Flag.NO_COVERAGE
        flags[fitted & held & ~footprint.weighted(positions).all(axis=0)] |= Flag.MASKED
    edge = open_edge(footprints, result.frame.shape)
    for c in result.components:
        (y, x), (n_y, n_x) = c.origin, c.morphology.shape
        bright = c.morphology > EDGE_LIGHT * c.morphology.max(initial=0.0)
        if (bright & edge[y : y + n_y, x : x + n_x]).any():
            flags[c.source] |= Flag.EDGE
    return flags
