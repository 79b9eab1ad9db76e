"""One observation for inspection: light of its pixels, positions of the sources."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...sky.box import Box
from ...sky.observation import Observation, masked
from ...sky.psf import SIGMAS_A_FWHM

# [pixels] Number of weights, evenly spread over the image, whose median gives the noise of a
# channel. Its error is a few percent of the scatter of weights, which suffices for thresholds.
N_WEIGHTS = 1000
# [model px] Lattice of points from which positions in the observation are taken to be affine.
LATTICE = np.array([(y, x) for y in (0.0, 0.5, 1.0) for x in (0.0, 0.5, 1.0)])
# Largest number of sources measured in an image, the brightest: more would only cost time.
MAX_SOURCES = 12
# Relative size below which an element of a matrix fitted to the lattice is a rounding error.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class InspectedImage:
    """One Observation with the positions of a blend's sources in its pixels.

    observation: Observation; usable (C, My, Mx): bool, pixels with a weight
    sigma (C,) [counts]: noise of a typical pixel, 1 of channels without a weight
    level (C,) [counts]: of the sky; 0 before `levels.sky_level`
    places (S, 2) [px]: of the sources; inside (S,): bool, those on a pixel of the image
    listed (S, 2) [px]: of the sources without the observation's shift
    matrix (2, 2), offset (2,): p = matrix X + offset, from model pixels to observed ones
    frame_shape (2,) [model px]: of the Frame
    """

    observation: Observation
    usable: np.ndarray
    sigma: np.ndarray
    level: np.ndarray
    places: np.ndarray
    inside: np.ndarray
    listed: np.ndarray
    matrix: np.ndarray
    offset: np.ndarray
    frame_shape: tuple[int, int]

    @classmethod
    def of(cls, observation, frame, positions, shift) -> InspectedImage:
        """The image of an observation, moved by `shift` (2,) [model px].

        Its sources are at `positions` (S, 2) [model px] of a Frame.
        """
        lattice = LATTICE * np.maximum(np.array(frame.shape) - 1.0, 1.0)
        points = np.concatenate([lattice, positions - shift, positions])
        found = frame.grid.positions_in(observation.grid, *points.T)
        found, places, listed = np.split(found, [len(lattice), len(lattice) + len(positions)])
        design = np.column_stack([lattice, np.ones(len(lattice))])
        good = np.isfinite(found).all(axis=1)
        solution = np.linalg.lstsq(design[good], found[good], rcond=None)[0]
        shape = np.array(observation.data.shape[1:])
        with np.errstate(invalid="ignore"):
            inside = np.all((places >= -0.5) & (places < shape - 0.5), axis=1)
        usable = observation.weights > 0
        sigma = typical_sigma(observation.weights)
        matrix = solution[:2].T
        matrix[np.abs(matrix) < ROUNDING * np.abs(matrix).max()] = 0  # upright grids stay upright
        offset = solution[2] - matrix @ shift
        level = np.zeros(len(sigma))
        given = places, inside, listed, matrix, offset, frame.shape
        return cls(observation, usable, sigma, level, *given)

    def over(self, level) -> InspectedImage:
        """The same InspectedImage with the level (C,) [counts] of its sky known."""
        return replace(self, level=level)

    def moved(self, shift) -> InspectedImage:
        """The same InspectedImage of the observation moved by a further shift (2,) [model px]."""
        return replace(self, offset=self.offset - self.matrix @ shift)

    def without(self, pixels) -> InspectedImage:
        """The same InspectedImage of the observation with the pixels (C, My, Mx) masked."""
        observation, usable = masked(self.observation, pixels), self.usable & ~pixels
        return replace(self, observation=observation, usable=usable)

    @cached_property
    def significance(self) -> np.ndarray:
        """Data above the level (C, My, Mx) [sigma of each pixel], 0 where not usable; float32."""
        data = self.observation.data - self.level[:, None, None]
        return np.where(self.usable, data * np.sqrt(self.observation.weights), 0).astype(np.float32)

    @cached_property
    def brightness(self) -> np.ndarray:
        """Data above the level (C, My, Mx) [sigma of a typical pixel], 0 where not usable; float32.

        Its shape is that of the light. That of the significance is flatter under photon noise.
        """
        data = self.observation.data - self.level[:, None, None]
        return brightness(data, self.usable, self.sigma)

    @cached_property
    def variance(self) -> np.ndarray:
        """Variance of `brightness` (C, My, Mx), 0 where not usable; float32."""
        found = np.zeros(self.usable.shape, np.float32)
        precision = self.observation.weights * self.sigma[:, None, None] ** 2
        return np.divide(1, precision, out=found, where=self.usable, casting="same_kind")

    @cached_property
    def smooth(self) -> np.ndarray:
        """Signal to noise (My, Mx) of points, all channels together with equal weight [1].

        Smoothed with a Gaussian as wide as the PSF: near a matched filter, whatever the PSF.
        """
        return self._smoothed(self.significance)

    @cached_property
    def smooth_brightness(self) -> np.ndarray:
        """`brightness` smoothed as `smooth` (My, Mx): the shape of the light."""
        return self._smoothed(self.brightness)

    def _smoothed(self, values):
        from scipy.ndimage import gaussian_filter

        width = max(self.width_px / SIGMAS_A_FWHM, 0.5)  # narrower ones are a single pixel
        total = values.sum(axis=0) / np.sqrt(len(values))
        smooth = gaussian_filter(total, width, mode="constant", truncate=3.0)
        return smooth * (2 * np.sqrt(np.pi) * width)

    @cached_property
    def light(self) -> np.ndarray:
        """Signal to noise (S,) of the pixel of `smooth` at each source; 0 outside the image."""
        return self.at_sources(self.smooth)

    @cached_property
    def brightest(self) -> np.ndarray:
        """Numbers (n,) of the brightest sources on the image, at most MAX_SOURCES."""
        order = np.argsort(-self.light, kind="stable")
        return order[self.inside[order]][:MAX_SOURCES]

    def at_sources(self, values) -> np.ndarray:
        """Values (S,) of an image (My, Mx) in the pixels of the sources; 0 outside the image."""
        top = np.array(self.usable.shape[1:]) - 1
        y, x = np.clip(np.rint(np.nan_to_num(self.places)).astype(int), 0, top).T
        return np.where(self.inside, values[y, x], 0)

    @cached_property
    def width_px(self) -> float:
        """FWHM [px] of the PSF, the median of the channels'."""
        return float(np.median(self.observation.psf.fwhm_px))

    @property
    def width_arcsec(self) -> float:
        """FWHM [arcsec] of the PSF."""
        return self.width_px * self.observation.grid.pixel_scale_arcsec

    def in_model(self, points) -> np.ndarray:
        """Points (..., 2) [px] of the image in model pixels."""
        return (points - self.offset) @ np.linalg.inv(self.matrix).T

    def on_frame(self, points) -> np.ndarray:
        """Selects points (..., 2) [px] on a pixel of the frame."""
        return Box.of(self.frame_shape).contains(self.in_model(points))

    def model_places(self, chosen) -> np.ndarray:
        """Places (n, 2) [model px] of sources `chosen` (n,)."""
        return self.in_model(self.places[chosen])

    def patches(self, chosen, reach):
        """Pixel numbers (n, h, h) [px] in y and in x about the places of sources `chosen` (n,).

        They reach `reach` pixels to each side; the third array says which lie on the image (n, h,
        h).
        """
        middle = np.rint(self.places[chosen]).astype(int)
        span = np.arange(-reach, reach + 1)
        y = middle[:, :1, None] + span[:, None]
        x = middle[:, 1:, None] + span
        y, x = np.broadcast_arrays(y, x)
        n_y, n_x = self.usable.shape[1:]
        on = (y >= 0) & (y < n_y) & (x >= 0) & (x < n_x)
        return np.clip(y, 0, n_y - 1), np.clip(x, 0, n_x - 1), on


def brightness(data, usable, sigma) -> np.ndarray:
    """Data (C, My, Mx) in units of sigma (C,), 0 where not usable; float32."""
    return np.where(usable, data / sigma[:, None, None], 0).astype(np.float32)


def typical_sigma(weights) -> np.ndarray:
    """Noise [counts] of a typical pixel of each channel (C,) of weights (C, My, Mx)."""
    return np.array([_typical_sigma(channel) for channel in weights])


def _typical_sigma(weights):
    """1 / sqrt of the median weight [counts] among pixels (My, Mx) that have one; 1 without."""
    flat = weights.ravel()
    some = flat[:: max(1, flat.size // N_WEIGHTS)]
    some = some[some > 0]
    if not some.size:
        some = flat[flat > 0]
    return 1 / np.sqrt(np.median(some)) if some.size else 1.0
