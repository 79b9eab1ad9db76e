"""Correlated noise: its description, its estimate, and the filter that whitens it.

Drizzled, resampled and stacked images share noise between neighbouring pixels. With sigma the
standard deviation of single pixels (from the weights) and rho the correlation of two pixels,

    noise = sigma e,   <e(x) e(x + d)> = rho(d),   P(f) = sum_d rho(d) exp(-2 pi i f.d)

and the filter w with the transform P^(-1/2) makes e white. Convolution on the observed pixels
multiplies the operator's transfer function by w's transform, exactly, at any rotation: an image
convolved with w is an image with white noise and the PSF convolved with w. Pixels that w mixes
with masked pixels, or with the outside of the image, get weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, convolve, gaussian_filter

from .filled import filled_pixels
from .psf import PSF
from .validation.checks import ReadOnly, as_float_array

# Lags that are estimated from an image [px]: drizzle and Lanczos kernels end within 5 pixels.
MAX_LAG_PX = 8
# [1] Floor of the noise power, relative to the largest. Below it resampling has removed the signal
# too; the floor increases the error of a star's flux by less than 2 %.
POWER_FLOOR = 0.03
# [px] Gaussian sigmas of the round sources by which the filter is chosen, and the tolerance of
# their flux errors. The filter is the smallest within this tolerance of the best that the floor
# permits: 1 to 5 pixels a side for drizzle and Lanczos kernels, 7 if these halve the pixels. Flux
# errors of smaller sources may deviate more.
ERROR_TOLERANCE, SIGMAS_PX = 0.015, (0.8, 1.2, 2.0, 4.0)
WEIGHT_ELSEWHERE = 0.1  # in the filter's fit, of frequencies where these sources have no power
MAX_RADIUS_PX = 6  # of the largest filter tried, 13 x 13 pixels
N_GRID = 64  # frequencies along each axis: far more than the filter's extent
# Blank sky excludes smoothed pixels above this many of their sigmas, and pixels within this
# distance of one. A lower limit would cut off the peaks of correlated noise and underestimate it.
BLANK_SIGMAS, BLANK_GROW_PX = 3.5, 5
# Pixel pairs needed at each lag to estimate a correlation: its error is then 0.03.
MIN_PAIRS = 1000


@dataclass(frozen=True, eq=False, init=False)
class NoiseCorrelation(ReadOnly):
    """Correlation of the noise of two pixels, the same all over an image.

    autocorrelation (2L + 1, 2L + 1) [1]: rho(dy, dx), symmetric, rho(0, 0) = 1; zero beyond
    filter (2r + 1, 2r + 1) [1]: w, which makes such noise white, with unit power, at all
        frequencies with at least 3 % of the largest noise power
    variance [1]: of a filtered pixel of unit noise; below 1 because of the other frequencies

    Raises ValueError for shapes that are not odd, values that are not finite, a centre that is not
    the largest value, and arrays that are not symmetric: no autocorrelation.
    """

    autocorrelation: np.ndarray
    filter: np.ndarray
    variance: float

    def __init__(self, autocorrelation):
        rho = as_float_array("autocorrelation", autocorrelation)
        if rho.ndim != 2 or rho.shape[0] % 2 == 0 or rho.shape[1] % 2 == 0:
            raise ValueError(
                f"autocorrelation has the shape {rho.shape}, must have odd numbers of lags a side, "
                "(2L + 1, 2L + 1), lag 0 in the middle"
            )
        peak = rho[rho.shape[0] // 2, rho.shape[1] // 2]
        if not np.isfinite(rho).all() or not peak > 0 or np.abs(rho).max() > peak * (1 + 1e-9):
            raise ValueError(
                f"autocorrelation is {peak:.3g} at lag 0 and reaches {np.abs(rho).max():.3g} "
                "elsewhere: its middle must be its largest value, and positive"
            )
        rho = rho / peak
        asymmetry = np.abs(rho - rho[::-1, ::-1]).max()
        if asymmetry > 1e-3:
            raise ValueError(
                f"autocorrelation differs by {asymmetry:.3g} from its own mirror image: rho(d) "
                "and rho(-d) must be equal"
            )
        rho = (rho + rho[::-1, ::-1]) / 2
        w, variance = _whitening(_power(rho))
        for name, array in (("autocorrelation", rho), ("filter", w)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "variance", variance)

    @classmethod
    def from_power_spectrum(cls, power) -> NoiseCorrelation:
        """From P (Ky, Kx) on the frequencies of numpy.fft.fftfreq, in any unit, not negative."""
        power = np.asarray(power, dtype=np.float64)
        if power.ndim != 2 or not np.isfinite(power).all() or (power < 0).any() or not power.any():
            raise ValueError(
                f"power spectrum of shape {power.shape} with values from {np.min(power):.3g}: it "
                "takes a 2-D array of finite numbers that are not negative"
            )
        rho = np.fft.fftshift(np.fft.ifft2(power).real)
        middle = [n // 2 for n in rho.shape]
        reach = [min(m, n - 1 - m, N_GRID // 2 - 1) for m, n in zip(middle, rho.shape)]
        box = tuple(slice(m - r, m + r + 1) for m, r in zip(middle, reach))
        return cls(rho[box])

    @classmethod
    def from_realisations(cls, images, *, weights=None, max_lag_px=MAX_LAG_PX) -> NoiseCorrelation:
        """From images (n, Ny, Nx), or one (Ny, Nx), of noise alone.

        Pixels without weight (as many weights as pixels) are left out.
        Raises ValueError where fewer than 1000 pairs of pixels are left at some lag.
        """
        images = np.asarray(images, dtype=np.float64)
        images = images[None] if images.ndim == 2 else images
        weights = np.ones(images.shape) if weights is None else np.asarray(weights, float)
        weights = np.broadcast_to(weights, images.shape)
        noise = np.where(weights > 0, images, 0) * np.sqrt(weights)
        return cls(_correlate(noise, weights > 0, max_lag_px))

    @classmethod
    def estimate(cls, image, weights, *, max_lag_px=MAX_LAG_PX) -> NoiseCorrelation:
        """Estimates it from the blank sky of an image (Ny, Nx) with weights (Ny, Nx).

        Blank are pixels under 3.5 sigma in a smoothed image, 5 pixels away from those above it.
        Pixels without data that are filled with a value are left out (`filled_pixels`).
        Raises ValueError where too little sky is left.
        """
        image, seen = np.asarray(image), np.asarray(weights) > 0
        seen &= ~filled_pixels(image, seen)
        noise = np.where(seen, image, 0) * np.sqrt(weights)
        blank = seen & ~_lit(noise, seen)
        noise = np.where(blank, noise - (noise[blank].mean() if blank.any() else 0), 0)
        return cls(_correlate(noise[None], blank[None], max_lag_px))

    @property
    def radius_px(self) -> int:
        """Half the extent of the filter: pixels this near to masks and edges get weight 0."""
        return self.filter.shape[0] // 2

    def filtered(self, images):
        """w * images (..., Ny, Nx), zero beyond the edge."""
        images = np.asarray(images, dtype=np.float64)
        taps = self.filter.reshape((1,) * (images.ndim - 2) + self.filter.shape)
        return convolve(images, taps, mode="constant")

    def colouring_filter(self) -> np.ndarray:
        """Filter (n, n), n odd, that makes this noise from white noise of unit variance.

        It is symmetric, with the transform P^(1/2).
        """
        root = np.fft.fftshift(np.fft.ifft2(np.sqrt(_power(self.autocorrelation))).real)
        return root[1:, 1:]  # of an even number of taps the middle one is n // 2

    def valid_after_filter(self, weights):
        """Pixels (..., Ny, Nx) that w mixes only with pixels of positive weight."""
        good = np.asarray(weights) > 0
        shape = (1,) * (good.ndim - 2) + self.filter.shape
        return ~binary_dilation(~good, np.ones(shape, bool), border_value=1)

    def error_factor(self, sigma_px):
        """Factor by which errors for white noise are too small for a Gaussian source of sigma [px].

        The ratio of the true scatter of its matched (white) filter's flux to the one that white
        noise of the same variance per pixel gives: sqrt(sum rho a) / sqrt(a(0)), a the
        autocorrelation of the source's image.
        """
        reach = [n // 2 for n in self.autocorrelation.shape]
        y, x = (np.arange(-r, r + 1) for r in reach)  # lags
        a = np.exp(-(y[:, None] ** 2 + x**2) / (4 * sigma_px**2))
        return float(np.sqrt(max((a * self.autocorrelation).sum(), 0)))

    def __repr__(self):
        reach = [n // 2 for n in self.autocorrelation.shape]
        neighbours = self.autocorrelation[reach[0], reach[1] + 1 : reach[1] + 2]
        next_one = neighbours[0] if len(neighbours) else 0.0
        return f"NoiseCorrelation({next_one:.2f} between neighbours, filter of {self.radius_px} px)"


def _power(rho):
    """P on the frequencies of numpy.fft.fftfreq(N_GRID) in both axes, negative values cut."""
    n = max(N_GRID, *(4 * (m // 2) + 2 for m in rho.shape))
    padded = np.zeros((n, n))
    padded[: rho.shape[0], : rho.shape[1]] = rho
    padded = np.roll(padded, [-(m // 2) for m in rho.shape], axis=(0, 1))
    return np.maximum(np.fft.fft2(padded).real, 0)


def _whitening(power):
    """The smallest filter w that gives right errors, and the variance that it leaves.

    Its taps minimise sum_f u(f) (W(f) P(f)^(1/2) - 1)^2, where u is the power of sources. Filtered
    with w, a source of power spectrum s has the claimed flux variance 1 / sum(s W^2) and the true
    flux variance sum(s W^4 P) / sum(s W^2)^2.
    """
    f = np.fft.fftfreq(len(power))
    distance = np.hypot(f[:, None], f)
    sources = np.exp(-((2 * np.pi * distance * np.reshape(SIGMAS_PX, (-1, 1, 1))) ** 2))
    u = (sources / sources.mean(axis=(1, 2), keepdims=True)).mean(axis=0) + WEIGHT_ELSEWHERE
    root = np.sqrt(np.maximum(power, POWER_FLOOR * power.max()))
    wanted = _error_ratios(sources, root**-2, power)
    for radius in range(MAX_RADIUS_PX + 1):
        y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        half = (y > 0) | ((y == 0) & (x >= 0))  # w is symmetric: one of each pair of taps
        waves = np.cos(2 * np.pi * (f[:, None, None] * y[half] + f[:, None] * x[half]))
        waves[:, :, 1:] *= 2
        columns = (waves * root[:, :, None]).reshape(-1, half.sum())
        weighted = columns * u.reshape(-1, 1)
        taps = np.linalg.solve(weighted.T @ columns, weighted.sum(axis=0))
        response = (waves @ taps) ** 2
        excess = _error_ratios(sources, response, power) - wanted
        if (excess <= ERROR_TOLERANCE).all() and (excess[1:] >= -ERROR_TOLERANCE).all():
            break
    w = np.zeros(half.shape)
    w[half] = taps
    w[~half] = w[::-1, ::-1][~half]
    return w, float((response * power).mean())


def _error_ratios(sources, response, power):
    """True over claimed flux errors (n,) of sources of power (n, N, N), |W|^2 being `response`."""
    true = (sources * response**2 * power).sum(axis=(1, 2))
    return np.sqrt(true / (sources * response).sum(axis=(1, 2)))


def _correlate(noise, good, max_lag_px):
    """rho (2L + 1, 2L + 1) of noise (n, Ny, Nx) where `good`, tapered in the outer half of lags."""
    shape = [n + max_lag_px for n in noise.shape[1:]]
    transforms = [np.fft.rfft2(a.astype(np.float64), shape) for a in (noise, good)]
    products, pairs = (np.fft.irfft2((np.abs(t) ** 2).sum(axis=0), shape) for t in transforms)
    lags = np.arange(-max_lag_px, max_lag_px + 1)
    at = np.ix_(lags, lags)
    if pairs[at].min() < MIN_PAIRS:
        raise ValueError(
            f"noise correlation: {pairs[at].min():.0f} pairs of blank pixels {max_lag_px} px apart,"
            f" {MIN_PAIRS} are needed: give an autocorrelation, or noise realisations"
        )
    rho = products[at] / pairs[at]
    distance = np.hypot(*np.meshgrid(lags, lags, indexing="ij")) / max_lag_px
    taper = np.where(distance < 0.5, 1, np.cos(np.pi * (distance - 0.5).clip(0, 0.5)) ** 2)
    rho = rho / rho[max_lag_px, max_lag_px] * taper
    return np.clip(rho, -1, 1)


def _lit(noise, seen):
    """Pixels with light of sources, and pixels near these."""
    smooth = gaussian_filter(noise, 2.0)
    level = smooth[seen]
    middle = np.median(level) if level.size else 0.0
    sigma = 1.4826 * np.median(np.abs(level - middle)) if level.size else 1.0
    lit = seen & (smooth - middle > BLANK_SIGMAS * max(sigma, 1e-300))
    return binary_dilation(lit, iterations=BLANK_GROW_PX)


def filtered_psf(psf: PSF, filters) -> tuple[PSF, np.ndarray]:
    """The PSF of images that were convolved with filters, and the filters' sums (C,).

    filters: C arrays (2r + 1, 2r + 1) [1], taps one pixel of the PSF's grid apart, one a band
    returns the PSF, larger by the filters and again of unit sum

    Raises ValueError if a pixel is not a whole number of samples.
    """
    step = round(1 / psf.spacing)
    if abs(step * psf.spacing - 1) > 1e-9:
        raise ValueError(
            f"spacing of the PSF is {psf.spacing} px: a filter on whole pixels needs samples that "
            "are 1, 1/2, 1/3 ... px apart"
        )
    n_y, n_x = psf.images.shape[1:]
    reach = step * max(f.shape[0] // 2 for f in filters)
    images = np.zeros((psf.n_bands, n_y + 2 * reach, n_x + 2 * reach))
    for image, taps, wide in zip(psf.images, filters, images, strict=True):
        start = reach - step * (taps.shape[0] // 2)
        for (i, j), tap in np.ndenumerate(taps):
            y, x = start + step * i, start + step * j
            wide[y : y + n_y, x : x + n_x] += tap * image
    sums = images.sum(axis=(1, 2))
    images /= sums[:, None, None]
    return PSF.restore(images, spacing=psf.spacing, center=psf.center + reach), sums


def channel_correlations(noise, data, weights, channels):
    """Correlations (C,) of an observation's channels, or None where all is white; and messages.

    noise: None, "estimate", a NoiseCorrelation or its autocorrelation for all channels, or a
        sequence of C of these; data, weights (C, Ny, Nx)

    Raises ValueError for another number of them, and as NoiseCorrelation and its `estimate` do.
    """
    if noise is None:
        return None, []
    one = isinstance(noise, (str, NoiseCorrelation)) or np.ndim(noise) == 2
    given = [noise] * len(data) if one else list(noise)
    if len(given) != len(data):
        raise ValueError(f"noise has {len(given)} correlations, data have {len(data)} channels")
    found, messages = [], []
    for correlation, image, weight, channel in zip(given, data, weights, channels, strict=True):
        if isinstance(correlation, str):
            if correlation != "estimate":
                raise ValueError(
                    f'noise is {correlation!r}, must be a NoiseCorrelation, an array or "estimate"'
                )
            try:
                correlation = NoiseCorrelation.estimate(image, weight)
            except ValueError as error:
                raise ValueError(f"channel {channel}: {error}") from None
            messages.append(
                f"noise of channel {channel} estimated from blank sky: {correlation!r}; for white "
                "noise, errors of a source of sigma 2 px would be too small by the factor "
                f"{correlation.error_factor(2.0):.2f}"
            )
        elif correlation is not None and not isinstance(correlation, NoiseCorrelation):
            correlation = NoiseCorrelation(correlation)
        found.append(correlation or NoiseCorrelation(np.ones((1, 1))))
    return tuple(found), messages
