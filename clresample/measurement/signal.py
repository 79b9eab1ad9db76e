"""Signal to noise of observations in the model's pixels, under filters of several widths.

For light of unit flux at x, a point convolved with a Gaussian G, the best linear estimate in one
channel, the matched filter, is

    n(x) = [G * P1 * R^T w d](x),    v(x) = [P1 * R^T w](x) |P2 * G|^2

and the signal to noise n / sqrt(v),

with R the operator from the model frame, P1 the model's PSF and P2 the observed one, w the weights
and d the data. R P1 is P2 at x: n is the sum of (P2 * G) w d over all observed pixels, wherever
they lie, and v its variance where the weights change little over the PSF.

Source: the matched filter, Zackay & Ofek 2017 (ApJ 836, 187); the sum of squares over bands,
Szalay, Connolly & Szokoly 1999 (AJ 117, 68).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..resampling.cache import cached_resampler
from ..sky.noise import sigma_below_zero

# [arcsec] Standard deviations of G: of points, of galaxies of the usual size in deep images (half
# of their light within 0.25 arcsec) and of large faint ones. A galaxy between two of them loses
# under a tenth of its signal to noise. Each more costs one transform a channel.
WIDTHS_ARCSEC = (0.0, 0.2, 0.5)
# of a channel's largest variance v: a point with less lies on pixels that are masked or not seen
LEAST_WEIGHT = 0.1
# [sigma^2] Sum of squares up to which its significance is tabulated; above, both grow alike
TABLE_END, TABLE_STEP = 400.0, 0.25


@dataclass(frozen=True, eq=False)
class Signal:
    """One observation's signal to noise.

    images (W, C, Ny, Nx) [sigma]: float32, of each width and channel; of unit scatter in white
        noise, 0 where a channel has not seen the sky
    seen (C, Ny, Nx) bool: where it has
    """

    images: np.ndarray
    seen: np.ndarray

    def flat(self, width=0):
        """Channels together (Ny, Nx) [sigma], as of a spectrum of equal signal to noise in all."""
        n_seen = self.seen.sum(axis=0)
        return self.images[width].sum(axis=0) / np.sqrt(np.maximum(n_seen, 1))

    def scatters(self):
        """Scatter (W,) of the channels together where there is no source, at least 1: that of the
        negative pixels, which are noise. Correlated noise has more."""
        flats = (self.flat(w) for w in range(len(self.images)))
        return np.array([max(1.0, sigma_below_zero(image) or 1.0) for image in flats])


def signal_of(observation, frame, device=None) -> Signal:
    """The Signal of an observation in a frame, under the filters of `WIDTHS_ARCSEC`."""
    from scipy import fft

    observation = observation.white
    op = cached_resampler(frame, observation.grid, observation.psf, dtype=np.float32, device=device)
    weights = observation.weights * op.covered
    # in units of the noise, so that float32 holds data of any scale
    unit = np.sqrt(weights.max(axis=(1, 2), keepdims=True))
    unit[unit == 0] = 1
    weights = weights / unit**2
    n = op.adjoint((weights * observation.data * unit).astype(np.float32))
    v = op.adjoint(weights.astype(np.float32))
    sigmas = np.array(WIDTHS_ARCSEC) / frame.grid.pixel_scale_arcsec
    # zeros beyond the edges, wide enough for the PSF and four sigma of the widest filter
    reach = max(frame.psf.images.shape[1:]) // 2 + int(4 * sigmas[-1])
    size = [fft.next_fast_len(s + reach, real=True) for s in frame.shape]
    nu_y, nu_x = np.fft.fftfreq(size[0]), np.fft.rfftfreq(size[1])
    model_psf = frame.psf.otf(nu_y, nu_x)[0].astype(np.complex64)
    inside = tuple(slice(s) for s in frame.shape)
    images = np.zeros((len(sigmas), len(n), *frame.shape), np.float32)
    seen = np.zeros(images.shape[1:], bool)
    powers = _powers(observation, frame, sigmas)
    for c in range(len(n)):
        variance = fft.irfft2(fft.rfft2(v[c], size) * model_psf, size)[inside]
        seen[c] = variance > LEAST_WEIGHT * variance.max(initial=0)
        scale = np.zeros(frame.shape, np.float32)
        scale[seen[c]] = 1 / np.sqrt(variance[seen[c]])
        light = fft.rfft2(n[c], size) * model_psf
        for w, sigma in enumerate(sigmas):
            if sigma:
                filtered = light * _gaussian(nu_y, sigma)[:, None] * _gaussian(nu_x, sigma)
            else:
                filtered = light
            image = fft.irfft2(filtered, size)[inside]
            images[w, c] = image * scale / np.sqrt(powers[w, c])
    return Signal(images, seen)


def combined(signals) -> tuple[np.ndarray, np.ndarray]:
    """All channels of Signals in one frame together: two images (Ny, Nx) [sigma].

    the first: as of a spectrum of equal signal to noise in all channels, under the narrowest filter
    the second: at each pixel the most significant of all widths, and of two sums over channels,
        that of the first, best for a source that all of them see, and the sum of the squares of
        those that are positive, best for one whose spectrum nothing is known of: very red ones or
        very blue ones are in few bands. Both are in units in which noise alone is normal. Noise
        reaches 5 in the largest of them six times as often as in one: once in 3e5 resolved places
    """
    n_seen = sum(s.seen.sum(axis=0) for s in signals)
    root = np.sqrt(np.maximum(n_seen, 1))
    first, best = None, None
    for w in range(len(WIDTHS_ARCSEC)):
        flat = sum(s.images[w].sum(axis=0) for s in signals) / root
        squares = sum((np.maximum(s.images[w], 0) ** 2).sum(axis=0) for s in signals)
        one = np.maximum(flat, significance(squares, n_seen))
        first, best = (flat, one) if first is None else (first, np.maximum(best, one))
    return first, best


def significance(squares, n_channels) -> np.ndarray:
    """Sigmas (...) of a normal distribution that noise reaches as often as it does such a sum.

        P(sum > q) = sum_k binomial(n, k) 2^-n P(chi^2_k > q)

    squares (...): sum over channels of the squares of the signal to noise that is positive
    n_channels (...): integers, how many were added
    """
    from scipy.special import binom, chdtrc, ndtri

    found = np.zeros(np.shape(squares), np.float32)
    knots = np.arange(0, TABLE_END + TABLE_STEP, TABLE_STEP)
    for n in np.unique(n_channels):
        if n == 0:
            continue
        beyond = sum(binom(n, k) / 2.0**n * chdtrc(k, knots) for k in range(1, n + 1))
        sigmas = -ndtri(np.maximum(beyond, 1e-300))
        at = n_channels == n
        q = np.asarray(squares)[at]
        above = sigmas[-1] + np.sqrt(np.maximum(q, TABLE_END)) - np.sqrt(TABLE_END)
        found[at] = np.where(q < TABLE_END, np.interp(q, knots, sigmas), above)
    return found


def _gaussian(nu, sigma):
    """Transform of a Gaussian of `sigma` [px] at frequencies nu [1/px]."""
    return np.exp(-2 * (np.pi * sigma * nu) ** 2).astype(np.float32)


def _powers(observation, frame, sigmas):
    """|P2 * G|^2 (W, C) of the PSFs under Gaussians of `sigmas` [model px], per observed pixel."""
    psf = observation.psf
    step = observation.grid.pixel_scale_arcsec * psf.spacing / frame.grid.pixel_scale_arcsec
    shape = [2 * n for n in psf.images.shape[1:]]
    nu_y, nu_x = (np.fft.fftfreq(n) for n in shape)
    power = np.abs(np.fft.fft2(psf.images, shape)) ** 2
    area = (psf.images**2).sum(axis=(1, 2)) / psf.spacing**2
    found = []
    for sigma in sigmas / step:
        gauss = np.exp(-4 * (np.pi * sigma) ** 2 * (nu_y[:, None] ** 2 + nu_x**2))
        found.append(area * (power * gauss).sum(axis=(1, 2)) / power.sum(axis=(1, 2)))
    powers = np.array(found)
    if len(powers[0]) == 1:  # one PSF for all channels
        powers = np.repeat(powers, observation.weights.shape[0], axis=1)
    return powers
