"""Changes of models that the posterior allows: images whose products are covariances.

With draws (A_k, S_k) of the posterior, clipped at 0:

    dm_k = sum_i R (A_ik S_ik - A_i S_i) / sqrt(K),    k = 1 .. K,

where R is the operator of the observation. A result read from a file without draws has covariances
of fluxes only. Then each model is assumed correct up to a factor,

    <dm_s dm_t> = m_s m_t cov(F_s, F_t) / (F_s F_t).
"""

from __future__ import annotations

import warnings

import numpy as np

from ...device.multi_device import one_blas_thread
from ...resampling.resampler import Resampler
from ...sky.box import intersect_boxes
from ...sky.psf_checks import PSFWarning
from ..component_images import source_image

# [FWHM of the observation's PSF] Margin around the window in which components' changes are
# rendered: less than 1e-3 of a morphology's light reaches the window from further away.
REACH_FWHM = 3.0


@one_blas_thread()
def deviations(result, chosen, i_observation, window):
    """Deviations (K, C, ny, nx) [counts] of the chosen sources' model and of all others'.

    chosen: numbers of sources; window: slices (y, x) of the observation
    """
    if result.draws is not None:
        return _of_draws(result, chosen, i_observation, window)
    return _of_fluxes(result, chosen, i_observation, window)


def _of_draws(result, chosen, i_observation, window):
    """Computes the deviations from draws of morphologies and spectra."""
    channels = result.channel_slices()[i_observation]
    rendered = result.rendered[i_observation]
    o, draws = result.observations[i_observation], result.draws
    corner, shape = _frame_part(result, i_observation, window)
    n_draws = len(draws.samples[0]) if result.components else 0
    n_channels = channels.stop - channels.start
    out_shape = tuple(part.stop - part.start for part in window)
    found = np.zeros((2, n_draws, n_channels, *out_shape))
    images = np.zeros((2, n_draws, n_channels, *shape), np.float32)
    for i, c in enumerate(result.components):
        which = 0 if c.source in chosen else 1
        here, there = intersect_boxes(
            (0, 0), shape, np.subtract(c.origin, corner), c.morphology.shape
        )
        seen = rendered.lit_within(i, window)
        inside = all(part.stop > part.start for part in here)
        if seen is None and not inside:
            continue
        morphs, spectra = draws.changes(i)
        drawn = np.maximum(c.spectrum + spectra, 0)[:, channels, None, None]
        if seen is not None:
            found[which] += (drawn - c.spectrum[channels, None, None]) * seen
        if inside and len(draws.modes[i]):
            own = c.morphology[there]
            change = np.where(own > 0, np.maximum(own + morphs[:, *there], 0) - own, 0)
            images[which][:, :, *here] += (drawn * change[:, None]).astype(np.float32)
    if images.any():
        y0, x0 = (part.start for part in window)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)  # the fit's operator has warned
            op = Resampler(
                result.frame.grid.cutout(*corner, shape),
                result.frame.psf,
                o.grid.cutout(y0, x0, out_shape),
                o.psf,
                shift=result.shifts[i_observation],
            )
        found += op(images.reshape(-1, *images.shape[2:])).reshape(found.shape)
    own, others = found / np.sqrt(max(n_draws, 1))
    return own, others


def _frame_part(result, i_observation, window):
    """First pixel and shape of the frame's part that a window observes, with a margin."""
    o, frame = result.observations[i_observation], result.frame
    y, x = ([part.start - 0.5, part.stop - 0.5] for part in window)
    rows, columns = np.repeat(y, 2), np.tile(x, 2)
    at = o.grid.positions_in(frame.grid, rows, columns) + result.shifts[i_observation]
    at = np.nan_to_num(at, nan=0.0)
    scale = o.grid.pixel_scale_arcsec / frame.grid.pixel_scale_arcsec
    reach = REACH_FWHM * float(o.psf.fwhm_px.max()) * scale
    top = np.array(frame.shape)
    low = np.clip(np.floor(at.min(axis=0) - reach), 0, top - 1).astype(int)
    high = np.clip(np.ceil(at.max(axis=0) + reach) + 1, low + 1, top).astype(int)
    return tuple(map(int, low)), tuple(map(int, high - low))


def _of_fluxes(result, chosen, i_observation, window):
    """Computes the deviations from covariances of fluxes; without Errors, of spectra."""
    channels, rendered = result.channel_slices()[i_observation], result.rendered[i_observation]
    n_y, n_x = (part.stop - part.start for part in window)
    units, owners, covariance = [], [], []
    if result.errors is None:
        covariance = result.covariance[channels]
        for i, c in enumerate(result.components):
            units.append(rendered.lit_within(i, window))
            owners.append(c.source)
    else:
        covariance = result.errors.flux[channels]
        for source in range(len(result.sources)):
            units.append(_unit_image(result, source, i_observation, window))
            owners.append(source)
    lit = [k for k, image in enumerate(units) if image is not None]
    found = np.zeros((2, len(lit), covariance.shape[0], n_y, n_x))
    if not lit:
        return found[0], found[1]
    pairs = covariance[:, lit][:, :, lit]
    roots = np.stack([_root(one) for one in pairs])  # (C, n, K)
    for row, k in enumerate(lit):
        which = 0 if owners[k] in chosen else 1
        found[which] += roots[:, row].T[:, :, None, None] * units[k]
    return found[0], found[1]


def _unit_image(result, source, i_observation, window):
    """A source's model (C, ny, nx) [1] on a window for a flux of one count."""
    image = source_image(result, source, i_observation, window)
    if image is None:
        return None
    channels = result.channel_slices()[i_observation]
    flux = sum(c.flux[channels] for c in result.components if c.source == source)
    known = flux > 0
    return np.where(known, 1 / np.where(known, flux, 1), 0)[:, None, None] * image


def _root(covariance):
    """Square root (n, n) of a covariance; rows of infinite variance are 0."""
    known = np.isfinite(np.diag(covariance))
    covariance = np.where(known[:, None] & known, covariance, 0.0)
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0))
