"""What one instrument saw of a patch of sky: pixels, weights, PSF and where it all lies."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..drawing.shown import ShownObservation
from .correlation import NoiseCorrelation, noise_of_channels
from .given.checks import ReadOnly, instance, numbers, split_mask
from .grid import Grid
from .noise import mask_from, weights_from
from .psf import PSF
from .varying.field import PSFField
from .varying.made import RepeatedPSF, filtered

# [mag] AB magnitude of 1 uJy
ZERO_POINT_UJY = 23.9


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Observation(ReadOnly, ShownObservation):
    """Images of one instrument, one per channel, on one pixel grid.

        chi2 = sum weights (model - data)^2

    data (C, Ny, Nx) [counts per pixel]: background-subtracted images; (Ny, Nx) is one channel. Read
        back, they are float64 and hold 0 where they were NaN or infinite
    psf: PSF of C bands, pixel response included; one band serves all channels. Or a PSFField: fits
        render each source with the PSF at its position
    grid: Grid of (Ny, Nx)
    weights [counts^-2]: inverse variance, 0 = ignore this pixel; or, instead of it,
    variance [counts^2]: NaN, infinite, zero and negative ones mean: ignore this pixel. Weights and
        variances are (C, Ny, Nx), or (Ny, Nx) for all channels, (C,) or one number for all pixels
    mask (C, Ny, Nx) or (Ny, Nx): True = ignore this pixel; may come with either of the two or
        alone. Masks of masked arrays among data, weights and variance mean the same
    channels (C,): names, unique over all instruments; None numbers them after `name`
    zero_points (C,) or one number [mag]: AB magnitude of one count
    noise: correlation of the noise of neighbouring pixels, in drizzled, resampled and stacked
        images: a NoiseCorrelation, or its autocorrelation (2L + 1, 2L + 1), for all channels, or C
        of these, or "estimate" from blank sky. None = white. Weights stay those of single pixels
    name: of the instrument, for messages

    With neither weights nor variance the noise is estimated, channel by channel, from the scatter
    of the background (`noise_sigma`), and reported: one number, without sources' photon noise.

    Read back: data and weights (C, Ny, Nx) float64, psf of C bands, that in the middle, psf_field
    of C bands where it varies, else None, zero_points and noise (C,) or None, n_bad = number of
    unmasked pixels whose weight became 0 because data, weight or variance is none, messages

    Raises ValueError for shapes that disagree, negative or infinite weights, masks not of 0 and 1,
    names not unique, weights beside variance, noise not to be found, and what is no real number.
    """

    data: np.ndarray
    psf: PSF
    psf_field: PSFField | None
    grid: Grid
    weights: np.ndarray
    channels: tuple[str, ...]
    zero_points: np.ndarray | None
    noise: tuple[NoiseCorrelation, ...] | None
    name: str | None
    n_bad: int
    messages: tuple[str, ...]

    def __init__(
        self,
        data,
        psf,
        grid,
        *,
        weights=None,
        variance=None,
        mask=None,
        channels=None,
        zero_points=None,
        noise=None,
        name=None,
    ):
        data, mask = _images(data, instance("grid", grid, Grid), mask)
        psfs = _psfs_of(psf, data.shape)
        bad = ~np.isfinite(data)
        channels = _channels(channels, name, len(data))
        zero_points = _per_channel("zero_points", zero_points, len(data))
        weights, n_bad, messages = weights_from(data, bad, weights, variance, mask, channels)
        data = np.where(bad, 0.0, data)
        noise, found = noise_of_channels(noise, data, weights, channels)
        messages += found
        self._set(
            data=data,
            **psfs,
            grid=grid,
            weights=weights,
            channels=channels,
            zero_points=zero_points,
            noise=noise,
            name=name,
            n_bad=n_bad,
            messages=tuple(messages),
        )

    def _set(self, **values):
        """The fields, images made read-only."""
        for key, value in values.items():
            if key in ("data", "weights"):
                value.flags.writeable = False
            object.__setattr__(self, key, value)

    @classmethod
    def restore(cls, data, psf, grid, *, weights, n_bad, messages, **given) -> Observation:
        """An observation as it was made once, from what is read back; n_bad and messages are those
        that were found then. Raises ValueError as the constructor does."""
        restored = cls(data, psf, grid, weights=weights, **given)
        restored._set(n_bad=int(n_bad), messages=tuple(messages))
        return restored

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, Ny, Nx)."""
        return self.data.shape

    @property
    def label(self) -> str:
        """What messages call this observation: its name, or else its channels."""
        return self.name or f"with channels {', '.join(self.channels)}"

    @cached_property
    def white(self) -> Observation:
        """The same light with white noise, which is what is fitted; itself where noise is white.

        Data and PSF are convolved with each channel's whitening filter; a constant stays, and
        pixels nearer to a mask or to the edge than the filter's radius have weight 0.
        """
        if self.noise is None:
            return self
        psf, sums = filtered(self.psf, self.psf_field, [n.filter for n in self.noise])
        data = self.as_white(self.data)
        weights = np.stack(
            [n.reached(w) * w * s**2 for n, w, s in zip(self.noise, self.weights, sums)]
        )
        names = {key: getattr(self, key) for key in ("channels", "zero_points", "name")}
        return Observation(data, psf, self.grid, weights=weights, **names)

    def as_white(self, images) -> np.ndarray:
        """Images (C, Ny, Nx) of this observation as they are in `white`."""
        if self.noise is None:
            return images
        pairs = zip(self.noise, images, strict=True)
        return np.stack([n.filtered(image) / n.filter.sum() for n, image in pairs])

    def chi2_map(self, residual) -> np.ndarray:
        """Weighted squared residuals (C, Ny, Nx) of expectation 1; NaN where nothing is known.

        residual (C, Ny, Nx) [counts]: data minus model; whitened here where noise is correlated
        """
        weights = self.weights
        if self.noise is None:
            squares = residual**2
        else:
            variance = np.array([n.variance for n in self.noise])
            squares = self.as_white(residual) ** 2 / variance[:, None, None]
            weights = self.white.weights
        return np.where(weights > 0, weights * squares, np.nan)

    @property
    def flux_scale(self) -> np.ndarray | None:
        """Flux of one count (C,) [uJy]: 10^(-0.4 (zero_points - 23.9)); None without them."""
        if self.zero_points is None:
            return None
        return 10 ** (-0.4 * (self.zero_points - ZERO_POINT_UJY))


def masked(observation, pixels) -> Observation:
    """The same observation with the pixels (C, Ny, Nx) bool masked: their weight is 0."""
    made = copy.copy(observation)
    made.__dict__.pop("white", None)  # that of the observation before
    made._set(weights=np.where(pixels, 0.0, observation.weights))
    return made


def check_observations(observations):
    """Raise ValueError unless these observations can be fitted together.

    There is at least one, channel names are unique over all of them, zero points are given by all
    of them or by none, and their grids are all flat or all placed by a WCS.
    """
    if not observations:
        raise ValueError("observations is empty, at least one is needed")
    first = {}
    for observation in observations:
        for channel in observation.channels:
            if channel in first:
                raise ValueError(
                    f"channel name {channel!r} is given twice, by the observations "
                    f"{first[channel].label!r} and {observation.label!r}"
                )
            first[channel] = observation
    for what, have in (
        ("zero_points", [o.zero_points is not None for o in observations]),
        ("a WCS", [not o.grid.is_flat for o in observations]),
    ):
        if len(set(have)) > 1:
            of, rest = (observations[have.index(there)].label for there in (True, False))
            raise ValueError(f"observation {of!r} has {what}, {rest!r} has none: give all or none")


def _images(data, grid, mask):
    """Data (C, Ny, Nx) float64 of as many pixels as the grid has, and the mask with data's own."""
    data, hidden = split_mask("data", data)
    data = numbers("data", data)
    if data.ndim == 2:
        data = data[None]
    if data.ndim != 3 or 0 in data.shape:
        raise ValueError(f"data must be (C, Ny, Nx) or (Ny, Nx), not {data.shape}")
    if data.shape[1:] != tuple(grid.shape):
        raise ValueError(f"data has images of {data.shape[1:]} pixels, grid has {grid.shape}")
    return data, mask if hidden is None else mask_from(mask, data.shape) | hidden


def _psfs_of(psf, shape):
    """psf and psf_field of images (C, Ny, Nx), each of one band for each channel, a single one
    serving all."""
    n_channels = shape[0]
    instance("psf", psf, (PSF, PSFField))
    if psf.n_bands not in (1, n_channels):
        raise ValueError(
            f"psf has {psf.n_bands} bands, data have {n_channels} channels: "
            "give one band, or one for each channel"
        )
    if isinstance(psf, PSF):
        psf = psf if psf.n_bands == n_channels else psf.select([0] * n_channels)
        return {"psf": psf, "psf_field": None}
    if psf.n_bands != n_channels:
        psf = RepeatedPSF(psf, n_channels)
    middle = psf.psf_at((shape[1] - 1) / 2, (shape[2] - 1) / 2)
    return {"psf": middle, "psf_field": psf if psf.varies else None}


def _channels(channels, name, n_channels):
    """Channel names (C,), numbered after the instrument where none are given."""
    if channels is None:
        return tuple(f"{name or 'channel'}{i}" for i in range(n_channels))
    channels = (channels,) if isinstance(channels, str) else tuple(channels)
    if len(channels) != n_channels:
        raise ValueError(f"channels has {len(channels)} names, data have {n_channels} channels")
    if not all(isinstance(channel, str) and channel for channel in channels):
        raise ValueError(f"channels must be names, not {channels}")
    if len(set(channels)) < n_channels:
        raise ValueError(f"channels must be unique, not {channels}")
    return channels


def _per_channel(name, values, n_channels):
    """Finite numbers (C,), from one for each channel or one for all; None for None."""
    if values is None:
        return None
    values = numbers(name, values)
    if values.shape not in ((), (n_channels,)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be one finite number or {n_channels}, one for each channel, not {values}"
        )
    values = np.broadcast_to(values, n_channels).copy()
    values.flags.writeable = False
    return values
