"""Shift between two images of one patch of sky, measured without a model of it.

Each image is convolved with the other's PSF, after which both have the same PSF. The light of the
sharper image, A, is divided among the sources by distance, so that each may have any colour, and

    V = b + sum_s [ a_s U_s - a_s t_s . grad U_s ],    V = P_A * d_B,    U_s = P_B * d_A of source s

is fitted to V at the pixels of B, to first order in the shifts t_s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import map_coordinates

from ...sky.psf import PSF

# [FWHM of the wider PSF] Radius of the pixels about a source that are compared.
RADIUS_FWHM = 1.2
# Relative ridge for sources that the images can hardly separate, of the size of rounding errors.
RIDGE = 1e-10
# Smallest number of pixels of a fit, beside three for each source.
MIN_PIXELS = 12
# [px of the coarser image] Smallest error of a source's shift, because of neighbours of other
# colours, structure, and errors of the PSFs.
FLOOR_PX = 0.02
# Fraction of a neighbour's light whose position is uncertain, because colours differ inside
# galaxies and light is divided by distance alone.
COLOUR = 0.2
# [FWHM] Half-width of the PSF images of these convolutions: light further out is nearly uniform
# around a source and does not affect the shift.
KERNEL_FWHM = 3.0
# Largest fraction of a pixel's light from unusable pixels; above it the pixel is left out.
HIDDEN = 0.02


@dataclass(frozen=True, eq=False)
class ImagePlane:
    """One channel of an InspectedImage.

    data (My, Mx) [sigma of a typical pixel]: above the sky, 0 where not usable; float32
    usable (My, Mx): bool; psf: PSF of one band; matrix, offset: as those of InspectedImage
    """

    data: np.ndarray
    usable: np.ndarray
    psf: PSF
    matrix: np.ndarray
    offset: np.ndarray

    @classmethod
    def of(cls, image, c) -> ImagePlane:
        """Channel c of an InspectedImage."""
        psf = image.observation.psf[c]
        return cls(image.brightness[c], image.usable[c], psf, image.matrix, image.offset)


def shifts_at(one: ImagePlane, other: ImagePlane, places) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of sources' light in the ImagePlane `other` against the sharper one, `one`.

    places (n, 2) [model px]: of the sources
    returns shifts (n, 2) [px of other] and their errors (n,), infinite where they are not measured
    """
    pair = Matched.of(one, other, places, RADIUS_FWHM)
    if pair.good.sum() < MIN_PIXELS + 3 * len(places):
        return np.zeros((len(places), 2)), np.full(len(places), np.inf)
    owner = _nearest(one.data.shape, places @ one.matrix.T + one.offset)
    images = [pair.light(one.data * (owner == s)) for s in range(len(places))]
    good = pair.good[pair.window]
    shifts, errors, brightness = _solved(images, pair.there(), good, np.sqrt(pair.area))
    near = pair.near - [part.start for part in pair.window]
    parts = np.array(
        [_foreign(images, brightness, s, near[s], pair.radius) for s in range(len(near))]
    )
    return shifts, np.hypot(errors, COLOUR * parts * pair.radius)


@dataclass(frozen=True, eq=False)
class Matched:
    """Two ImagePlanes, each to be convolved with the other's PSF, at the pixels of the second one.

    at (2, My, Mx) [px of the first]: of these pixels; area: pixels of the first in one of them
    near (n, 2), radius [px]: of the sources' pixels; good (My, Mx): bool, those compared
    window: slices of all of them, with a pixel more on each side, from which slopes follow
    smear, smear_there: Blur of the first and of the second
    """

    other: ImagePlane
    at: np.ndarray
    area: float
    near: np.ndarray
    radius: float
    good: np.ndarray
    window: tuple[slice, slice]
    smear: Blur
    smear_there: Blur

    @classmethod
    def of(cls, one, other, places, radius_fwhm) -> Matched:
        """The pixels of ImagePlanes within some FWHM of the wider PSF of places (n, 2) [model px].

        The window is empty without any.
        """
        # a position p in `other` lies at matrix p + offset in `one`
        matrix = one.matrix @ np.linalg.inv(other.matrix)
        offset = one.offset - matrix @ other.offset
        area = abs(np.linalg.det(matrix))
        shape = other.data.shape
        at = (np.stack([*np.indices(shape)], axis=-1) @ matrix.T + offset).transpose(2, 0, 1)
        smear, there = Blur(one, other.psf, matrix), Blur(other, one.psf, np.linalg.inv(matrix))
        near = places @ other.matrix.T + other.offset
        radius = radius_fwhm * max(other.psf.fwhm_px[0], one.psf.fwhm_px[0] / np.sqrt(area))
        top = np.array(one.data.shape)[:, None, None] - 1
        # splines of light that is cut at the edge lie below it within a pixel
        good = other.usable & ((at >= 1) & (at <= top - 1)).all(axis=0) & ~there.hidden
        if smear.hidden.any():
            hidden = smear.hidden.astype(np.float32)
            good &= map_coordinates(hidden, at, order=1, mode="nearest") < 0.5
        about = _within(shape, near, radius)
        lit = [np.flatnonzero(about.any(axis=axis)) for axis in (1, 0)]
        y, x = (slice(max(on[0] - 1, 0), on[-1] + 2) if on.size else slice(0) for on in lit)
        return cls(other, at, area, near, radius, good & about, (y, x), smear, there)

    def light(self, data) -> np.ndarray:
        """Data of the first one at the pixels of the window, behind both PSFs."""
        options = {"order": 3, "mode": "constant", "prefilter": False, "output": float}
        spline = self.smear.of(data, spline=True)
        return self.area * map_coordinates(spline, self.at[:, *self.window], **options)

    def there(self) -> np.ndarray:
        """Data of the second one at the pixels of the window, behind both PSFs."""
        return self.smear_there.of(self.other.data)[self.window].astype(float)


def _foreign(images, brightness, s, place, radius):
    """Light of another colour from other sources near source s, as part of its own light.

    Infinite if the source has no light of its own.
    """
    y, x = (np.arange(n) - p for n, p in zip(images[s].shape, place, strict=True))
    near = y[:, None] ** 2 + x**2 <= radius**2
    light = np.array([np.abs(image[near]).sum() for image in images])
    if not (brightness[s] > 0 and light[s] > 0):
        return np.inf
    return (np.abs(brightness / brightness[s] - 1) @ light) / light[s]


def _within(shape, places, radius):
    """Pixels of an image of this shape within a radius [px] of one of the places (n, 2)."""
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])
    near = np.zeros(shape, bool)
    for a, b in places:
        near |= (y - a) ** 2 + (x - b) ** 2 <= radius**2
    return near


def _nearest(shape, places):
    """Index of the place (n, 2) [px] nearest to each pixel: (Ny, Nx)."""
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])
    return np.stack([(y - a) ** 2 + (x - b) ** 2 for a, b in places]).argmin(axis=0)


def _solved(images, there, good, noise):
    """Shifts (n, 2), their errors (n,) and the brightness (n,) of sources in the image `there`.

    Computed from the good pixels of the sources' images (n), whose noise is `noise`; that of
    `there` is 1.
    """
    n = len(images)
    light = np.stack([image[good] for image in images])
    slopes = np.stack([[s[good] for s in np.gradient(image)] for image in images])  # (n, 2, P)
    value = there[good]
    a = _brightness(light, value)
    moving = -(a[:, None, None] * slopes).reshape(2 * n, -1)
    design = np.vstack([np.ones_like(value), light, moving])
    scale = np.maximum(np.sqrt((design**2).sum(axis=1)), 1e-300)
    design /= scale[:, None]
    normal = design @ design.T
    inverse = np.linalg.inv(normal + RIDGE * np.eye(len(normal)))
    solution = inverse @ (design @ value)
    rest = value - solution @ design
    variance = 1 + (np.abs(a).max() * noise) ** 2
    variance = max(variance, (rest @ rest) / max(value.size - len(solution), 1))
    shifts = (solution / scale)[1 + n :].reshape(n, 2)
    errors = np.sqrt(variance * np.diag(inverse)) / scale
    errors = np.hypot(*errors[1 + n :].reshape(n, 2).T) / np.sqrt(2)
    errors = np.where(a > 0, np.hypot(errors, FLOOR_PX), np.inf)
    return shifts, errors, a


def _brightness(light, value):
    """Brightness (n,) of the light (n, P) of the sources in pixels of `value` (P,), noise 1.

    Sources that cannot be separated share their total brightness.
    """
    total = np.stack([np.ones_like(value), light.sum(axis=0)])
    background, mean = np.linalg.lstsq(total.T, value, rcond=None)[0]
    rest = value - background - mean * total[1]
    normal = light @ light.T + max(abs(mean), 1e-100) ** -2 * np.eye(len(light))
    return mean + np.linalg.solve(normal, light @ rest)


class Blur:
    """Convolution of images on a ImagePlane's pixels with another PSF.

    hidden (My, Mx): pixels that thereby hold light of unusable ones
    """

    def __init__(self, plane, psf, matrix):
        """matrix (2, 2): from the PSF's pixels to the ImagePlane's."""
        width = psf.fwhm_px[0] * np.sqrt(abs(np.linalg.det(matrix)))
        reach = int(np.ceil(KERNEL_FWHM * width)) + 1
        side = 2 * reach
        nu = np.fft.fftfreq(side), np.fft.rfftfreq(side)
        kernel = fft.irfft2(psf.otf(*nu, matrix)[0], (side, side))
        size = [fft.next_fast_len(max(n + reach, side), real=True) for n in plane.data.shape]
        padded = np.zeros(size)
        padded[:side, :side] = fft.fftshift(kernel)
        padded = np.roll(padded, (-reach, -reach), (0, 1)).astype(np.float32)
        self._transfer = fft.rfft2(padded)
        self._size, self._inside = size, tuple(slice(n) for n in plane.data.shape)
        self.hidden = np.zeros(plane.data.shape, bool)
        if not plane.usable.all():
            self.hidden = self.of(~plane.usable) > HIDDEN

    def of(self, image, spline=False):
        """An image (My, Mx) convolved, without light from beyond its edges.

        spline: coefficients of the cubic B-splines through its pixels instead
        """
        transform = fft.rfft2(np.asarray(image, np.float32), self._size) * self._transfer
        if spline:
            n_y, n_x = self._size
            at_pixels = (2 + np.cos(2 * np.pi * fft.fftfreq(n_y))[:, None]) / 3
            transform /= at_pixels * (2 + np.cos(2 * np.pi * fft.rfftfreq(n_x))) / 3
        return fft.irfft2(transform, self._size)[self._inside]
