"""Structure that a fit has left in its residuals, source by source and channel by channel."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from clresample import PSF

# Least number of sky pixels that say how much correlated noise adds up under the filter.
MIN_PIXELS = 400
HALF_NORMAL = 0.6745  # median of |x| for x of unit normal scatter
NO_WEIGHT = 1e-6  # of a channel's largest filtered weight: what is seen with less is not seen


def worst_residuals(result, i_observation):
    """Largest |filtered residual| of each source in each channel: (S, Co) [sigma], NaN unseen.

        t(p) = sum_q P(q - p) w(q) r(q) / sqrt( sum_q P(q - p)^2 w(q) )

    with the residual r, the weights w, and the observed PSF P: how significant a point source at p
    would be in what is left.  A pixel belongs to the brightest model among the sources whose boxes
    hold it.  Correlated noise adds up under the filter: where a channel has 400 pixels of sky,
    those with less than one sigma of model, t is divided by its robust scatter there, if over 1.
    """
    observation, footprint = result.observations[i_observation], result.footprints[i_observation]
    weights = np.where(footprint.used, observation.weights, 0.0)
    filtered = _filtered(np.nan_to_num(result.residual(i_observation)), weights, _psf(observation))
    models = np.stack([result.source_model(s, i_observation) for s in range(len(result.sources))])
    dark = (models.sum(axis=0) * np.sqrt(weights) < 1) & (weights > 0)
    for image, sky in zip(filtered, dark, strict=True):
        if sky.sum() >= MIN_PIXELS:
            image /= max(1.0, np.nanmedian(np.abs(image[sky])) / HALF_NORMAL)
    held = np.stack([_in_box(result, s, footprint.positions) for s in range(len(models))])
    brightest = np.where(held[:, None], models, -np.inf).argmax(axis=0)  # (Co, My, Mx)
    found = np.full(models.shape[:2], np.nan)
    for s, channel in np.ndindex(found.shape):
        own = held[s] & (brightest[channel] == s) & np.isfinite(filtered[channel])
        if own.any():
            found[s, channel] = np.abs(filtered[channel][own]).max()
    return found


def _filtered(residual, weights, kernels):
    """t (Co, My, Mx); NaN where nothing was seen."""
    found = np.full(residual.shape, np.nan)
    for t, r, w, kernel in zip(found, residual, weights, kernels, strict=True):
        kernel = kernel[::-1, ::-1]
        variance = fftconvolve(w, kernel**2, mode="same")
        seen = (variance > NO_WEIGHT * variance.max()) & (w > 0)
        t[seen] = fftconvolve(w * r, kernel, mode="same")[seen] / np.sqrt(variance[seen])
    return found


def _psf(observation):
    """Images of the PSF on the observation's pixels; of an oversampled one, Gaussians as wide."""
    psf = observation.psf
    if psf.spacing == 1:
        return psf.images
    area_px = [np.count_nonzero(im > im.max() / 2) * psf.spacing**2 for im in psf.images]
    sigma_px = np.sqrt(np.array(area_px) / np.pi) / 1.1774  # half width at half maximum / sigma
    return PSF.gaussian(sigma_px, pixel=False).images


def _in_box(result, i_source, positions):
    """Which observed pixels, at (My, Mx, 2) [model px], lie in a box of the source."""
    inside = np.zeros(positions.shape[:-1], bool)
    for component in result.components:
        if component.source == i_source:
            low = np.array(component.origin) - 0.5
            inside |= ((positions >= low) & (positions < low + component.morphology.shape)).all(
                axis=-1
            )
    return inside
