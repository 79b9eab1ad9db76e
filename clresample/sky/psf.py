"""Point-spread functions as samples, and their transform (OTF), exact at any frequency."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..drawing.display import PSFDisplay
from .fourier import uniform_waves
from .nufft import nufft_type2
from .psf_checks import PSFWarning, core_centroid, fwhm, light_beyond_edge, psf_warnings
from .validation.checks import ReadOnly, as_float_array, check_number

# Relative tolerance of the band's edge, larger than the rounding of A^T nu in float64.
BAND_SLACK = 1e-12
# [px] Largest distance of two samples, and the inverse of the smallest: others are errors of unit.
COARSEST = 1e3
SPACINGS = f"a positive number of pixels, from {1 / COARSEST:g} to {COARSEST:g}"
SIGMAS_A_FWHM = math.sqrt(8 * math.log(2))  # of a Gaussian
# [samples] Largest distance of a centre from the middle of the array: others are errors of unit.
FAR = 1e3
# [complex numbers] One block of the general transform's tables: 16 MiB, about the size of the
# cache. Larger blocks are read back from memory, smaller ones make many small products.
BLOCK = 1 << 20
# [samples] Rotated PSF images of at least this size are transformed by an FFT and interpolation,
# which takes 5 us a frequency instead of 26 us for the sum over all samples. Its error of 1e-14 of
# the light is near float64's rounding. Smaller images use the sum, which is exact.
LARGE = 256 * 256


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PSF(ReadOnly, PSFDisplay):
    """PSF images of one instrument, each band divided by its own sum.

    images (C, ny, nx) [1]: samples, pixel response included; a single (ny, nx) image is one band
    spacing [px]: distance of two samples in pixels of the PSF's grid; 0.5 = 2x oversampled
    center (C, 2) [samples]: (y, x) array coordinates of each band's centre. None = the geometric
        centre (n-1)/2; "core" = the centroid of each band's core; else (2,) or (C, 2)

    Raises ValueError for wrong shapes, NaN or infinite samples, sums that are not positive, and
    centres more than FAR from the middle. Issues a PSFWarning for each of `warnings`.
    """

    images: np.ndarray
    spacing: float
    center: np.ndarray

    def __init__(self, images, *, spacing=1.0, center=None):
        images = np.array(as_float_array("images", images))
        if images.ndim == 2:
            images = images[None]
        if images.ndim != 3 or 0 in images.shape:
            raise ValueError(f"images must be (C, ny, nx) or (ny, nx), not {images.shape}")
        spacing = check_number(
            "spacing", spacing, SPACINGS, lambda x: 1 / COARSEST <= x <= COARSEST
        )
        for i_band, image in enumerate(images):
            n_bad = np.count_nonzero(~np.isfinite(image))
            if n_bad:
                raise ValueError(f"images: band {i_band} has {n_bad} NaN or infinite samples")
            # a sum that cancels to rounding is no normalisation
            if not image.sum() > 1e-12 * np.abs(image).sum():
                raise ValueError(f"images: band {i_band} has the sum {image.sum():.3g}, not > 0")
        images /= images.sum(axis=(1, 2), keepdims=True)
        self._set(images, spacing, _center(images, center))
        for message in self.warnings():
            warnings.warn(message, PSFWarning, stacklevel=2)

    def _set(self, images, spacing, center):
        """The three fields, arrays made read-only."""
        for array in (images, center):
            array.flags.writeable = False
        object.__setattr__(self, "images", images)
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "center", center)

    @classmethod
    def gaussian(cls, sigma_px, *, n_pixels=41, pixel=True, n_bands=1, spacing=1.0) -> PSF:
        """Round Gaussian, integrated over pixels by error functions unless `pixel` is False.

        sigma_px [px]: standard deviation, one number or one per band
        n_pixels [samples]: size of the image, one number or (ny, nx)
        pixel: convolve with the (square, unit) pixel of the grid the PSF belongs to
        n_bands: number of bands when sigma_px is one number
        spacing [px]: distance of two samples

        Raises ValueError for a sigma that is not positive.
        """
        sigmas = np.atleast_1d(as_float_array("sigma_px", sigma_px))
        if sigmas.ndim != 1 or not (np.isfinite(sigmas) & (sigmas > 0)).all():
            raise ValueError(f"sigma_px must be positive numbers, not {sigma_px}")
        if sigmas.size == 1:
            sigmas = np.repeat(sigmas, n_bands)
        elif n_bands not in (1, sigmas.size):
            raise ValueError(f"sigma_px has {sigmas.size} bands, n_bands is {n_bands}")
        n_y, n_x = np.broadcast_to(n_pixels, 2)
        profile = _pixel_gaussian if pixel else _gaussian
        axes = [[profile(n, spacing, sigma) for n in (n_y, n_x)] for sigma in sigmas]
        return cls(np.stack([np.outer(y, x) for y, x in axes]), spacing=spacing)

    @classmethod
    def restore(cls, images, *, spacing, center) -> PSF:
        """A PSF with exactly these `images`, `spacing` and `center`.

        images (C, ny, nx) are not divided by their sums again, and there are no checks and no
        warnings, which the original PSF had.
        """
        psf = object.__new__(cls)
        images, center = np.array(images, np.float64), np.array(center, np.float64)
        psf._set(images, float(spacing), center)
        return psf

    def on_pixels(self, pixel) -> PSF:
        """The same PSF for a grid with pixels of a side `pixel` [px]."""
        if pixel == 1:
            return self
        return PSF.restore(self.images, spacing=self.spacing / pixel, center=self.center)

    @property
    def n_bands(self) -> int:
        """C."""
        return self.images.shape[0]

    @cached_property
    def fwhm_px(self) -> np.ndarray:
        """Width (C,) [px]: diameter of the disc that the samples above half of the peak fill."""
        width = np.array([fwhm(image) for image in self.images]) * self.spacing
        width.flags.writeable = False
        return width

    def __getitem__(self, bands) -> PSF:
        return self.select(bands)

    def select(self, bands) -> PSF:
        """The PSF of some bands only: a number, a slice, or a sequence of numbers.

        Raises ValueError for a band that it does not have.
        """
        if isinstance(bands, (int, np.integer)):
            bands = [bands]
        try:
            images, center = self.images[bands], self.center[bands]
        except (IndexError, TypeError, ValueError):
            images = self.images[:0]
        if images.ndim != 3 or not len(images):
            raise ValueError(f"bands {bands!r:.80} of a PSF that has {self.n_bands}")
        return PSF.restore(images, spacing=self.spacing, center=center)

    def otf(self, nu_y, nu_x, matrix=None) -> np.ndarray:
        """Optical transfer function: the samples' transform at any frequencies f = A^T nu.

            P^(f) = sum_s P[s] exp(-2 pi i f.(s - center) spacing),  0 where |f|_inf > 1/(2 spacing)

        nu_y (Ky,), nu_x (Kx,) [cycles per pixel]: frequencies, axis by axis, of the other grid
        matrix (2, 2): A, from this PSF's pixels to those of the other grid; None = identity
        returns (C, Ky, Kx) complex128

        Raises ValueError for a matrix that is not (2, 2). Source: eq. `psf_diff`, at frequencies
        instead of pixels, so that no PSF image is ever interpolated.
        """
        matrix = np.eye(2) if matrix is None else np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (2, 2):
            raise ValueError(f"matrix must be (2, 2), not {matrix.shape}")
        nu_y, nu_x = (np.asarray(nu, dtype=np.float64).ravel() for nu in (nu_y, nu_x))
        (a, b), (c, d) = matrix
        limit = (1 + BAND_SLACK) / (2 * self.spacing)
        outside = np.abs(a * nu_y[:, None] + c * nu_x) > limit
        outside |= np.abs(b * nu_y[:, None] + d * nu_x) > limit
        result = np.empty((self.n_bands, nu_y.size, nu_x.size), dtype=np.complex128)
        # bands that share a centre share the exponentials
        rows = [tuple(row) for row in self.center.tolist()]
        for center in dict.fromkeys(rows):
            bands = np.array([band for band, row in enumerate(rows) if row == center])
            result[bands] = _transform(self, bands, center, nu_y, nu_x, matrix)
        result[:, outside] = 0
        return result

    def core(self) -> np.ndarray:
        """Centroid of each band's core: Gaussian-weighted, from the brightest sample on.

        returns (C, 2) [samples]: (y, x) array coordinates
        """
        return np.stack([core_centroid(image) for image in self.images])

    def edge_light(self) -> np.ndarray:
        """Light beyond the edge (C,), as a fraction of the light inside; see `psf_checks`."""
        return light_beyond_edge(self.images)

    def warnings(self, core='center="core"') -> list[str]:
        """Warnings about this PSF, a sentence each; see `psf_checks.psf_warnings`."""
        return psf_warnings(self.images, self.center, core)


def _center(images, center):
    """Centres (C, 2) [samples] from the user's argument."""
    n_bands, n_y, n_x = images.shape
    if isinstance(center, str):
        if center != "core":
            raise ValueError(f'center must be "core", (2,) or (C, 2) numbers, not "{center}"')
        return np.stack([core_centroid(image) for image in images])
    if center is None:
        center = ((n_y - 1) / 2, (n_x - 1) / 2)
    center = as_float_array("center", center)
    if center.shape not in ((2,), (n_bands, 2)) or not np.isfinite(center).all():
        raise ValueError(f"center must be (2,) or ({n_bands}, 2) finite numbers, not {center}")
    if (np.abs(center - [n_y / 2, n_x / 2]) > FAR).any():
        raise ValueError(f"center is {center.tolist()}, over {FAR:g} samples from their middle")
    return np.broadcast_to(center, (n_bands, 2)).copy()


def _offsets(n, spacing):
    """Positions (n,) [px] of samples about the middle of their axis."""
    return (np.arange(n) - (n - 1) / 2) * spacing


def _gaussian(n, spacing, sigma):
    """A Gaussian at the samples (n,); sigma and spacing [px]."""
    return np.exp(-0.5 * (_offsets(n, spacing) / sigma) ** 2)


def _pixel_gaussian(n, spacing, sigma):
    """Its integral over the unit pixel around each (n,); erfc of |u| keeps the wings' digits."""
    width = math.sqrt(2) * sigma
    offsets = np.abs(_offsets(n, spacing))
    return np.array([math.erfc((u - 0.5) / width) - math.erfc((u + 0.5) / width) for u in offsets])


def _waves(frequencies, first, step, n):
    """exp(-2 pi i f u) as (F, n), at u = first + step k."""
    return np.conj(uniform_waves(frequencies, first, step, n).T, order="C")


def _transform(psf, bands, center, nu_y, nu_x, matrix):
    """`otf` of some bands, all centred at `center`, without the band's edge: (bands, Ky, Kx)."""
    images = psf.images[bands]
    # smaller images of some bands have zeros around them
    lit = images.any(axis=0)
    (y1, y2), (x1, x2) = (_lit(lit.any(axis=axis), 0) for axis in (1, 0))
    images, y0, x0 = images[:, y1:y2, x1:x2], center[0] - y1, center[1] - x1
    n_y, n_x = images.shape[1:]
    (a, b), (c, d) = matrix * psf.spacing

    # f.(u, v) = nu_y (a u + b v) + nu_x (c u + d v), u and v in samples from the centre
    def along_y(nu, rate):
        return _waves(nu, -rate * y0, rate, n_y)

    def along_x(nu, rate):
        return _waves(nu, -rate * x0, rate, n_x)

    if b == c == 0:
        return along_y(nu_y, a) @ images @ along_x(nu_x, d).T
    if a == d == 0:
        return along_x(nu_y, b) @ images.transpose(0, 2, 1) @ along_y(nu_x, c).T
    if images[0].size > LARGE:
        f_y, f_x = (p * nu_y[:, None] + q * nu_x for p, q in ((a, c), (b, d)))
        turns = f_y * y0 + f_x * x0
        return nufft_type2(images, f_y, f_x) * np.exp(2j * np.pi * (turns - np.rint(turns)))
    # the images are real: if nu_x has both signs, sums for one sign give those for the other
    n_half = nu_x.size // 2 if nu_x.size % 2 and np.array_equal(nu_x, -nu_x[::-1]) else 0
    nu_half = nu_x[n_half:]
    waves_yu, waves_yv = along_y(nu_y, a), along_x(nu_y, b)
    waves_xu, waves_xv = along_y(nu_half, c), along_x(nu_half, d)
    sums = np.zeros((len(bands), 2, nu_y.size, 2, nu_half.size))  # of cos and sin by cos and sin
    n_rows = max(1, BLOCK // (n_x * (nu_y.size + nu_x.size)))
    for i in range(0, n_y, n_rows):
        rows = slice(i, i + n_rows)
        left = _parts(waves_yu[:, rows, None] * waves_yv[:, None])
        right = _parts(waves_xu[:, rows, None] * waves_xv[:, None])
        for k in range(len(bands)):
            sums[k] += (left @ (right * images[k, rows].ravel()).T).reshape(sums.shape[1:])
    cos_cos, cos_sin, sin_cos, sin_sin = (sums[:, i, :, k] for i in (0, 1) for k in (0, 1))
    result = np.empty((len(bands), nu_y.size, nu_x.size), dtype=np.complex128)
    result.real[..., n_half:] = cos_cos - sin_sin
    result.imag[..., n_half:] = cos_sin + sin_cos
    if n_half:
        result.real[..., :n_half] = (cos_cos + sin_sin)[..., :0:-1]
        result.imag[..., :n_half] = (sin_cos - cos_sin)[..., :0:-1]
    return result


def _parts(waves):
    """Real and imaginary parts of waves (F, n, m), one below the other: (2F, n m)."""
    flat = waves.reshape(len(waves), -1)
    return np.concatenate([flat.real, flat.imag])


def crop_psf(psf, share):
    """Removes a PSF's outer rows and columns with no more than this share of any band's light.

    Its transform changes by so much at most. Not divided by its sum again.
    """
    light = np.abs(psf.images)
    light = light / np.maximum(light.sum(axis=(1, 2), keepdims=True), 1e-300)
    (y0, y1), (x0, x1) = (_lit(light.sum(axis).max(axis=0), share / 4) for axis in (2, 1))
    if (y1 - y0, x1 - x0) == light.shape[1:]:
        return psf
    images, center = psf.images[:, y0:y1, x0:x1], psf.center - (y0, x0)
    return psf.restore(images, spacing=psf.spacing, center=center)


def cut_psf(psf, radius):
    """A PSF's samples within `radius` (2,) [px] along y and x of each band's centre.

    Not divided by its sum again.
    """
    given = np.array(psf.images.shape[1:])
    size = np.minimum(2 * np.ceil(radius / psf.spacing).astype(int) + 1, given)
    if (size == given).all():
        return psf
    first = np.clip(np.rint(psf.center).astype(int) - size // 2, 0, given - size)
    images = [
        image[y : y + size[0], x : x + size[1]]
        for image, (y, x) in zip(psf.images, first.tolist(), strict=True)
    ]
    return psf.restore(np.stack(images), spacing=psf.spacing, center=psf.center - first)


def _lit(light, share):
    """First and one-past-last element of light (n,), beyond which lies no more than `share`."""
    first = np.searchsorted(np.cumsum(light), share, side="right")
    last = len(light) - np.searchsorted(np.cumsum(light[::-1]), share, side="right")
    return (int(first), int(last)) if first < last else (0, len(light))
