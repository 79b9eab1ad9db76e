"""Signal to noise of observations under filters of several widths, in the model's pixels.

For light of unit flux at x, a point convolved with a Gaussian G, the best linear estimate in one
channel is the matched filter: with weights w, data d and the PSF P, K = P * G,

    n(x) = sum_q K(q - x) w(q) d(q),    v(x) = sum_q K(q - x)^2 w(q)

and the signal to noise n / sqrt(v). It is computed on the observation's own pixels. As it is twice
as smooth as the PSF, it can then be interpolated to the model's pixels by cubic splines.

Beside pixels without weight v falls faster than the light n of a bright source, so that n / sqrt(v)
has ridges and peaks along them. Where there is clear light these pixels therefore get the mean
light and weight of the pixels about them, weighted by a Gaussian as wide as the PSF: it is less
than that of the brightest of these, so that no new peaks arise.

Source: the matched filter, Zackay & Ofek 2017 (ApJ 836, 187); the sum of squares over bands,
Szalay, Connolly & Szokoly 1999 (AJ 117, 68).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..deblending.posterior.residuals import TOGETHER_PX
from ..sky.noise import sigma_below_zero
from ..sky.psf import SIGMAS_A_FWHM
from .levels import deficit_of, level_of

# [arcsec] Standard deviations of G: for points, for galaxies of typical size in deep images (half
# of their light within 0.25 arcsec) and for large faint ones. A galaxy between two of them loses
# less than a tenth of its signal to noise. Each further width costs one transform a channel.
WIDTHS_ARCSEC = (0.0, 0.2, 0.5)
SMALL_GALAXY = 1  # which of them is that of galaxies of the usual size
# [1] Smallest part of the narrowest filter's power on pixels with weight: with less a pixel counts
# as unobserved. The size of their weights does not matter: it is small in bright cores, whose
# photons are noise themselves, and in shallow parts of mosaics.
MIN_SEEN = 0.1
# [1] of a channel's largest weight, and of its largest variance v: smaller ones count as none,
# since n is lost in the rounding of float32. Of stars and galaxies whose photon noise was 5 to 4e4
# times the sky's variance all were found whole; bad pixels of 1e6 times are holes.
NO_WEIGHT = 1e-5
SAME_PX = 1e-3  # [px] distance below which model and observed pixels coincide
# [1] of the narrowest filter's power, with that on filled pixels: smallest part on pixels with
# weight of their own where light counts as measured.
MIN_OWN = 0.9
# [1] Smallest part of the Gaussian that lies on pixels with weight, for others to get their light.
MIN_ABOUT = 0.02
# [sigma] Mean light under the Gaussian from which it counts, with a weight that grows from 0: mean
# noise would count several times. With 0, noise with a strip of 6 px in each 200 px has two false
# sources in 1000 x 1000 px.
CLEAR_LIGHT = 5.0
# [sigma^2] Sum of squares up to which its significance is tabulated; above, both grow alike
TABLE_END, TABLE_STEP = 400.0, 0.25


@dataclass(frozen=True, eq=False)
class SignalToNoise:
    """One observation's signal to noise; of unit scatter in white noise.

    sums, squares (W, Ny, Nx): float32, in the model's pixels, of each width: the sum over channels
        of the signal to noise, and of the squares of its positive values; 0 if not observed
    n_seen (Ny, Nx): number of channels that cover a pixel
    channels (C, My, Mx) [sigma]: of the narrowest filter, on the observation's pixels
    places (Ny, Nx, 2) [px]: of the model's pixels on these
    measured (Ny, Nx) bool: pixels that are seen, with MIN_OWN of their signal from pixels with
        weight in every channel
    """

    sums: np.ndarray
    squares: np.ndarray
    n_seen: np.ndarray
    channels: np.ndarray
    places: np.ndarray
    measured: np.ndarray

    def flat(self, width=0):
        """Channels together (Ny, Nx) [sigma], as of a spectrum of equal signal to noise in all."""
        return self.sums[width] / np.sqrt(np.maximum(self.n_seen, 1))

    def scatters(self):
        """Scatter (W,) of the channels together where there is no source, at least 1.

        It is measured from negative pixels, which are noise. Correlated noise scatters more.
        """
        flats = (self.flat(w) for w in range(len(self.sums)))
        return np.array([max(1.0, sigma_below_zero(image) or 1.0) for image in flats])

    def divided_by(self, scatters):
        """The same in units of these scatters (W,)."""
        by = np.asarray(scatters, np.float32)[:, None, None]
        sums, squares, channels = self.sums / by, self.squares / by**2, self.channels / by[0]
        return replace(self, sums=sums, squares=squares, channels=channels)

    def levelled(self):
        """The signal without smooth levels (levels.py), and those of its sky alone (W,) [sigma].

        Sums of squares are omitted where there is a level, since it enters them in every channel.
        """
        sums, squares, skies = self.sums.copy(), self.squares.copy(), []
        root = np.sqrt(np.maximum(self.n_seen, 1))
        for w in range(len(sums)):
            level, sky = level_of(self.flat(w), self.n_seen > 0)
            sums[w] -= np.where(self.n_seen > 0, level * root, 0)
            squares[w][level != 0] = 0
            skies.append(sky)
        return replace(self, sums=sums, squares=squares), np.array(skies)

    def spectra(self, at):
        """Signal to noise (n, C) [sigma] of the channels at pixels (n, 2) of the model.

        Pixels outside get the value of the nearest observed pixel, or 0 if there is none.
        """
        at = np.clip(at, 0, np.array(self.n_seen.shape) - 1)
        places = np.rint(self.places[at[:, 0], at[:, 1]]).astype(int)
        shape = np.array(self.channels.shape[1:])
        inside = ((places >= 0) & (places < shape)).all(axis=1)
        places = np.clip(places, 0, shape - 1)
        return np.where(inside, self.channels[:, places[:, 0], places[:, 1]], 0).T


def signal_of(observation, frame, places=None, *, deficits=True) -> SignalToNoise:
    """The SignalToNoise of an observation in a frame, under the filters of `WIDTHS_ARCSEC`.

    deficits: without the levels of skies of which too much was subtracted, see levels.py
    places (Ny, Nx, 2) [px]: of the frame's pixels on the observation; None = by their grids
    """
    from scipy import fft

    observation = observation.whitened
    if places is None:
        places = frame.grid.map_to(observation.grid).at(*np.indices(frame.shape))
    sigmas = np.array(WIDTHS_ARCSEC) / observation.grid.pixel_scale_arcsec
    n_channels, *shape = observation.data.shape
    # beyond the edges pixels without weight, to be filled, then zeros that are wide enough for the
    # PSF and four sigma of the widest filter
    psf = observation.psf
    edge = int(np.ceil(psf.fwhm_px.max()))
    reach = int(max(psf.images.shape[1:]) * psf.spacing) // 2 + int(4 * sigmas[-1]) + 1
    size = [fft.next_fast_len(n + 2 * edge + reach, real=True) for n in shape]
    nu = np.fft.fftfreq(size[0]), np.fft.rfftfreq(size[1])
    inside = (..., *(slice(edge, edge + n) for n in shape))
    totals = np.zeros((2, len(sigmas), *shape), np.float32)
    channels = np.zeros(observation.data.shape, np.float32)
    seen, measured = np.zeros(shape, np.int16), np.ones(shape, bool)
    step = max(1, TOGETHER_PX // math.prod(size))
    for first in range(0, n_channels, step):
        c = slice(first, first + step)
        data, weights = (
            np.pad(image[c], ((0, 0), (edge, edge), (edge, edge)))
            for image in (observation.data, observation.weights)
        )
        unit = weights.max(axis=(1, 2), keepdims=True)
        unit = np.where(unit > 0, unit, 1.0)  # so that float32 holds data of any scale
        known = weights > NO_WEIGHT * unit
        data, weights = _without_holes(data, weights, known, psf.fwhm_px[c])
        light = fft.rfft2((weights / unit**0.5 * data).astype(np.float32), size)
        weight = fft.rfft2((weights / unit).astype(np.float32), size)
        transfer = psf.select(c).otf(*nu).astype(np.complex64)
        for w, sigma in enumerate(sigmas):
            kernel = transfer * _gaussian(nu[0], sigma)[:, None] * _gaussian(nu[1], sigma)
            power = fft.rfft2(fft.irfft2(kernel, size) ** 2)
            variance = fft.irfft2(weight * power.conj(), size)[inside]
            most = variance.max(axis=(1, 2), keepdims=True, initial=0)
            some = variance > NO_WEIGHT * most
            images = fft.irfft2(light * kernel.conj(), size)[inside]
            images = np.where(some, images / np.sqrt(np.where(some, variance, 1)), 0)
            if deficits:
                areas = np.abs(kernel[:, 0, 0]) ** 2 / power[:, 0, 0].real
                for image, own, area in zip(images, some, areas, strict=True):
                    image[own] -= np.broadcast_to(deficit_of(image, own, area), own.shape)[own]
            for image in images:  # added one by one, whatever the step
                totals[0, w] += image
                totals[1, w] += np.maximum(image, 0) ** 2
            if w == 0:
                channels[c] = images
                lit, own = (
                    fft.irfft2(fft.rfft2(mask.astype(np.float32), size) * power.conj(), size)[
                        inside
                    ]
                    for mask in (weights > NO_WEIGHT * unit, known)
                )
                some &= lit > MIN_SEEN * power[:, :1, :1].real
                seen += some.sum(axis=0, dtype=np.int16)
                measured &= (~some | (own >= MIN_OWN * lit)).all(axis=0)
    found, n_seen, measured = _in_frame(totals.reshape(-1, *shape), seen, measured, places)
    found = found.reshape(2, len(sigmas), *frame.shape)
    return SignalToNoise(found[0], np.maximum(found[1], 0), n_seen, channels, places, measured)


def _without_holes(data, weights, known, fwhm_px):
    """Data and weights (C, My, Mx) with those of the pixels about them where none are `known`.

    Light below CLEAR_LIGHT has no weight.

    known (C, My, Mx) bool: pixels with weight; fwhm_px (C,): of the PSF
    """
    from scipy.ndimage import gaussian_filter

    data, weights = data.copy(), np.where(known, weights, 0)
    for c, fwhm in enumerate(fwhm_px):
        sigma = fwhm / SIGMAS_A_FWHM
        about = gaussian_filter(known[c].astype(np.float32), sigma, mode="constant")
        hole = ~known[c] & (about > MIN_ABOUT)
        light, weight, squares = (
            gaussian_filter(image, width, mode="constant")[hole]
            for image, width in (
                (weights[c] * data[c], sigma),
                (weights[c], sigma),
                (weights[c], sigma / np.sqrt(2)),  # of the squared Gaussian
            )
        )
        noise = np.sqrt(squares / (4 * np.pi * sigma**2))
        trust = 1 - np.square(CLEAR_LIGHT * noise / np.maximum(light, CLEAR_LIGHT * noise))
        data[c][hole], weights[c][hole] = light / weight, trust * weight / about[hole]
    return data, weights


def _in_frame(images, seen, measured, places):
    """Images (n, My, Mx), channels that cover each pixel, and measured pixels, in the frame.

    Images are interpolated, 0 where nothing was seen; where all places are pixels they are taken.
    seen, measured (My, Mx): int and bool; places (Ny, Nx, 2) [px]: of the frame's pixels
    """
    from scipy.ndimage import map_coordinates

    nearest = np.rint(places)
    found = np.zeros((len(images), *places.shape[:2]), np.float32)
    if np.abs(places - nearest).max(initial=0) < SAME_PX:
        size = np.array(seen.shape)
        inside = ((nearest >= 0) & (nearest < size)).all(axis=-1)
        at = np.clip(nearest, 0, size - 1).astype(np.intp)
        at = at[..., 0] * size[1] + at[..., 1]
        n_seen = np.where(inside, seen.ravel()[at], 0)
        for total, image in zip(images, found, strict=True):
            image[n_seen > 0] = total.ravel()[at[n_seen > 0]]
        return found, n_seen, (n_seen > 0) & measured.ravel()[at]
    at = np.moveaxis(places, -1, 0)
    n_seen = map_coordinates(seen, at, order=0)
    for total, image in zip(images, found, strict=True):
        map_coordinates(total, at, order=3, output=image)
        image[n_seen == 0] = 0
    return found, n_seen, (n_seen > 0) & map_coordinates(measured, at, order=0)


def combine_bands(signals) -> tuple[np.ndarray, np.ndarray]:
    """All channels of SignalToNoises in one frame together: two images (Ny, Nx) [sigma].

    the first: for a spectrum of equal signal to noise in all channels, under the narrowest filter
    the second: at each pixel the most significant value of all widths and of two sums over
        channels. One is the sum of the first image, best for sources visible in all channels. The
        other is the sum of the squares of positive values, best for unknown spectra, such as very
        red or very blue ones. Both have a normal distribution for noise. Their maximum reaches 5 in
        noise six times as often as a single one: once in 3e5 resolution elements
    """
    n_seen = sum(s.n_seen for s in signals)
    root = np.sqrt(np.maximum(n_seen, 1))
    flats = [sum(s.sums[w] for s in signals) / root for w in range(len(WIDTHS_ARCSEC))]
    best = np.maximum.reduce(flats)
    for w in range(len(WIDTHS_ARCSEC)):
        squares = sum(s.squares[w] for s in signals)
        best = np.maximum(best, significance(squares, n_seen))
    return flats[0], best


def significance(squares, n_channels) -> np.ndarray:
    """Significance (...) [sigma] of sums of squares: normal deviates of equal probability in noise.

        P(sum > q) = sum_k binomial(n, k) 2^-n P(chi^2_k > q)

    squares (...): sum over channels of the squares of the signal to noise that is positive
    n_channels (...): integers, how many were added
    """
    found = np.zeros(np.shape(squares), np.float32)
    for n in np.unique(n_channels).tolist():
        if n == 0:
            continue
        knots, sigmas = _table(n)
        at = n_channels == n
        q = np.asarray(squares)[at]
        above = sigmas[-1] + np.sqrt(np.maximum(q, TABLE_END)) - np.sqrt(TABLE_END)
        found[at] = np.where(q < TABLE_END, np.interp(q, knots, sigmas), above)
    return found


@lru_cache(maxsize=64)
def _table(n):
    """Sums of squares, and the `significance` of each with n channels."""
    from scipy.special import binom, chdtrc, ndtri

    knots = np.arange(0, TABLE_END + TABLE_STEP, TABLE_STEP)
    beyond = sum(binom(n, k) / 2.0**n * chdtrc(k, knots) for k in range(1, n + 1))
    return knots, -ndtri(np.maximum(beyond, 1e-300))


def _gaussian(nu, sigma):
    """Transform of a Gaussian of `sigma` [px] at frequencies nu [1/px]."""
    return np.exp(-2 * (np.pi * sigma * nu) ** 2).astype(np.float32)
