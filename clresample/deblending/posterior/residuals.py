"""Measures structure in the residuals of a fit, by source and channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.noise import HALF_WIDTH, second_differences
from ...sky.psf import SIGMAS_A_FWHM
from ..component_images import source_image
from ..solver.multiscale.prior import gaussian

# [sigma] Filtered residual from which a source is flagged as misfitted: noise reaches it in one of
# 20 large blends, each with 1e5 pixels in all channels.
MISFIT_SIGMAS = 5.0
# Smallest number of sky pixels to measure how much correlated noise adds up under the filter.
MIN_PIXELS = 400
# Largest ratio of the scatter of single sky pixels to that about their neighbours that is
# attributed to noise: the noise of published weight maps is wrong by 10 to 30 %.
WRONG_WEIGHTS = 1.3
# The same ratio for filtered pixels: noise correlated over two pixels by resampling is two or three
# times larger after the filter than in single pixels.
CORRELATED = 3.0
# [1] of a channel's largest filtered weight: pixels with less are ignored.
MIN_WEIGHT = 1e-6
# [px] Largest size of several channels' images that are transformed in one call. For blends a call
# costs as much as its arithmetic; larger images, such as tiles, are transformed one by one.
TOGETHER_PX = 1 << 17
# [px] Half side of the Gaussians in place of oversampled PSFs.
KERNEL_PX = 20


@dataclass(frozen=True, eq=False)
class Remainder:
    """One observation's residual, whitened and filtered with its PSF (Co, My, Mx).

    filtered [sigma]: t of `max_filtered_residuals`, NaN unseen
    point [counts]: error of the flux of a point source there, which t times it is
    power (Co,) [1]: sum of the squared PSF: power t point is the residual smoothed with the PSF
    residual [sigma]: of single pixels, 0 without weight
    used, sky (bool): pixels with a weight; those of them with less than one sigma of model
    noise (Co,) [1]: ratio of the noise's variance to that of the weights, 1 or more
    owner: the source with the brightest model in a pixel, or -1
    """

    filtered: np.ndarray
    point: np.ndarray
    power: np.ndarray
    residual: np.ndarray
    used: np.ndarray
    sky: np.ndarray
    noise: np.ndarray
    owner: np.ndarray

    def worst(self, n_sources):
        """The largest |t| of each source in each channel (S, Co) [sigma], NaN unseen."""
        found = np.full((n_sources, len(self.filtered)), np.nan)
        for c, image in enumerate(self.filtered):
            own = (self.owner[c] >= 0) & np.isfinite(image)
            np.fmax.at(found[:, c], self.owner[c][own], np.abs(image[own]))
        return found


def remainder(result, i_observation) -> Remainder:
    """The Remainder of an observation of a fitted blend."""
    footprint = result.footprints[i_observation]
    observation = result.observations[i_observation].whitened
    weights = np.where(footprint.used, observation.weights, 0.0)
    model = result.observations[i_observation].whiten(result.model(i_observation))
    residual = np.where(weights > 0, observation.data - model, 0.0)
    kernels = _kernels(observation.psf)
    filtered, point = _filtered(residual, weights, kernels)
    scaled, sky = residual * np.sqrt(weights), weights > 0
    sky &= (model * np.sqrt(weights) < 1) & np.isfinite(filtered)
    noise = np.ones(len(weights))
    for c, image in enumerate(filtered):
        if sky[c].sum() < MIN_PIXELS:
            continue
        plain, scale = _scatter(scaled[c][sky[c]]), _scatter(image[sky[c]])
        if plain > WRONG_WEIGHTS or scale > CORRELATED:
            fine = fine_scatter(scaled[c], weights[c] > 0)
            plain, scale = min(plain, WRONG_WEIGHTS * fine), min(scale, CORRELATED * fine)
        noise[c] = plain**2
        image /= scale
        point[c] *= scale
    owner = _owners(result, i_observation, footprint.positions)
    power = (kernels**2).sum((1, 2))
    return Remainder(filtered, point, power, scaled, weights > 0, sky, noise, owner)


def max_filtered_residuals(result, i_observation):
    """Largest |filtered residual| of each source in each channel: (S, Co) [sigma], NaN unseen.

        t(p) = sum_q P(q - p) w(q) r(q) / sqrt( sum_q P(q - p)^2 w(q) )

    with the residual r, the weights w, and the observed PSF P: the significance of a point source
    at p in the residuals. For noise t has unit scatter. A pixel belongs to the source with the
    brightest model among those whose boxes contain it. If a channel has 400 pixels of sky, those
    with less than one sigma of model, t is divided by its robust scatter there if that exceeds 1,
    because the noise is then correlated or larger than the weights imply. The divisor is at most
    CORRELATED times the scatter of single pixels about their neighbours, since more scatter is
    light missing in the model.

    result: a fitted blend; i_observation: number of the observation
    """
    return remainder(result, i_observation).worst(len(result.sources))


def _scatter(values):
    """Robust scatter, 1 or more, of values (n,) of the sky."""
    middle = (len(values) - 1) // 2, len(values) // 2
    size = np.partition(np.abs(values), middle)  # half the time of np.median
    return max(1.0, size[list(middle)].mean() / HALF_WIDTH)


def fine_scatter(image, used):
    """Robust scatter, 1 or more, of pixels (Ny, Nx) [sigma] about their neighbours.

    By second differences: smooth light, which a model may lack, has none.
    """
    both, whole = second_differences(image, used)
    if whole.sum() < MIN_PIXELS // 2:
        return 1.0
    return max(1.0, np.median(np.abs(both[whole])) / (6 * HALF_WIDTH))


def channel_residuals(result):
    """`max_filtered_residuals` in all channels of all observations: (S, C) [sigma].

    If the result has Errors, returns the residuals from which their scale factors were computed.
    """
    if result.errors is not None:
        return result.errors.residuals
    return result.misfit.residuals


def misfit_error_scale(residuals):
    """Factors (S,), 1 or more, of the errors of sources with these `channel_residuals` (S, C).

    A model error that leaves a residual of r sigma also biases the source's flux, position and
    shape, by more than the noise. Above the threshold of misfits, errors are multiplied by r / 5.
    For 102 simulated COSMOS galaxies, in blends with others whose light is in part negative, this
    raises the fraction of positions within their errors from 0.62 to 0.70, of sizes from 0.52 to
    0.61, and of fluxes from 0.64 to 0.73.
    """
    worst = np.nan_to_num(residuals).max(axis=1, initial=0)
    return np.maximum(1, worst / MISFIT_SIGMAS)


def convolved(image, psf):
    """Images (..., Ny, Nx) convolved with PSFs (..., ny, nx), zeros being assumed beyond the edges.

    Equals scipy.signal.fftconvolve(mode="same") up to rounding, whose import takes half a second.
    The transforms wrap light beyond one edge onto pixels beyond the other: half its padding is
    enough.
    """
    from scipy import fft  # takes 0.05 s, not needed by all fits

    shape, taps = image.shape[-2:], psf.shape[-2:]
    size = [
        fft.next_fast_len(max(n + k // 2, k), real=True) for n, k in zip(shape, taps, strict=True)
    ]
    product = fft.rfft2(image, size) * fft.rfft2(psf, size)
    y, x = ((k - 1) // 2 for k in taps)
    return fft.irfft2(product, size)[..., y : y + shape[0], x : x + shape[1]]


def _filtered(residual, weights, kernels):
    """t (Co, My, Mx), NaN where nothing was seen, and the `point` of Remainder."""
    found, point = np.full((2, *residual.shape), np.nan)
    step = max(1, TOGETHER_PX // residual[0].size)
    for first in range(0, len(residual), step):
        c = slice(first, first + step)
        w, kernel = weights[c], kernels[c, ::-1, ::-1]
        variance, sums = convolved(np.stack([w, w * residual[c]]), np.stack([kernel**2, kernel]))
        most = variance.max(axis=(1, 2), keepdims=True, initial=0)
        seen = (variance > MIN_WEIGHT * most) & (w > 0)
        root = np.sqrt(variance, out=np.ones_like(variance), where=seen)
        np.divide(1, root, out=point[c], where=seen)
        np.multiply(sums, point[c], out=found[c], where=seen)
    return found, point


def _kernels(psf):
    """Images of the PSF on the observation's pixels; of an oversampled one, Gaussians as wide."""
    if psf.spacing == 1:
        return psf.images
    sigma_px = psf.fwhm_px / SIGMAS_A_FWHM
    sides = [gaussian(sigma, KERNEL_PX, unit_sum=True) for sigma in sigma_px]
    return np.array([np.outer(side, side) for side in sides])


def _owners(result, i_observation, positions):
    """Brightest source (Co, My, Mx) among those whose boxes contain a pixel.

    -1 without any.
    """
    shape = result.observations[i_observation].shape
    owner, most = np.full(shape, -1), np.full(shape, -np.inf)
    for s, window, inside in pixels_in_boxes(result, i_observation, positions):
        light = source_image(result, s, i_observation, window)
        if light is None:
            continue
        best, first = most[:, *window], owner[:, *window]  # views
        brighter = inside & (light > best)
        np.copyto(first, s, where=brighter)
        np.copyto(best, light, where=brighter)
    return owner


def pixels_in_boxes(result, i_observation, positions):
    """The pixels whose centre lies in a box of a source, for each source that has components.

    positions (My, Mx, 2) [model px]: of the observation's pixels
    yields the source, a window (slices y, x) of the observation that holds them all, and where they
        are in it (bool)
    """
    boxes = [(np.array(c.origin) - 0.5, c.morphology.shape) for c in result.components]
    owners = np.array([c.source for c in result.components], int)
    for s in np.unique(owners):
        parts = np.flatnonzero(owners == s)
        window = result.rendered[i_observation].window(*parts)
        (y, x), inside = np.moveaxis(positions[window], -1, 0), None
        for (y0, x0), (n_y, n_x) in (boxes[i] for i in parts):
            one = (y >= y0) & (y < y0 + n_y) & (x >= x0) & (x < x0 + n_x)
            inside = one if inside is None else inside | one
        yield s, window, inside
