"""What one instrument saw of a patch of sky: pixels, weights, PSF and where it all lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .grid import Grid
from .noise import noise_sigma
from .psf import PSF

# [mag] AB magnitude of 1 uJy
ZERO_POINT_UJY = 23.9


@dataclass(frozen=True, eq=False, init=False)
class Observation:
    """Images of one instrument, one per channel, on one pixel grid.

        chi2 = sum weights (model - data)^2

    data (C, Ny, Nx) [counts per pixel]: background-subtracted images; (Ny, Nx) is one channel. Read
        back, they are float64 and hold 0 where they were NaN or infinite
    psf: PSF of C bands, pixel response included; one band serves all channels
    grid: Grid of (Ny, Nx)
    weights [counts^-2]: inverse variance, 0 = ignore this pixel; or, instead of it,
    variance [counts^2]: NaN, infinite, zero and negative ones mean: ignore this pixel. Weights and
        variances are (C, Ny, Nx), or (Ny, Nx) for all channels, (C,) or one number for all pixels
    mask (C, Ny, Nx) or (Ny, Nx): True = ignore this pixel; may come with either of the two or alone
    channels (C,): names, unique over all instruments; None numbers them after `name`
    zero_points (C,) or one number [mag]: AB magnitude of one count
    name: of the instrument, for messages

    With neither weights nor variance the noise is estimated, channel by channel, from the scatter
    of the background (`noise_sigma`), and `messages` says so. That is one number for the whole
    image: it leaves out the sources' own photon noise, and in resampled or stacked images, whose
    noise is correlated between pixels, it is the scatter of single pixels, from which chi2 comes
    out too small and flux errors too optimistic.

    Read back: data and weights (C, Ny, Nx) float64, psf of C bands, grid, channels, zero_points
    (C,) or None, name, n_bad = number of unmasked pixels whose weight became 0 because their data
    were NaN or infinite, their weight NaN, or their variance NaN or not positive, messages = what
    the user should know.

    Raises ValueError for shapes that disagree, negative or infinite weights, masks that are not
    made of 0 and 1, channel names that are not unique, both weights and variance, and where the
    noise cannot be estimated.
    """

    data: np.ndarray
    psf: PSF
    grid: Grid
    weights: np.ndarray
    channels: tuple[str, ...]
    zero_points: np.ndarray | None
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
        name=None,
    ):
        data = _numbers("data", data)
        if data.ndim == 2:
            data = data[None]
        if data.ndim != 3 or 0 in data.shape:
            raise ValueError(f"data must be (C, Ny, Nx) or (Ny, Nx), not {data.shape}")
        if data.shape[1:] != tuple(grid.shape):
            raise ValueError(f"data has images of {data.shape[1:]} pixels, grid has {grid.shape}")
        n_channels = len(data)
        if psf.n_bands not in (1, n_channels):
            raise ValueError(
                f"psf has {psf.n_bands} bands, data have {n_channels} channels: "
                "give one band, or one for each channel"
            )
        if psf.n_bands != n_channels:
            psf = psf.select([0] * n_channels)
        channels = _channels(channels, name, n_channels)
        if zero_points is not None:
            zero_points = _per_channel("zero_points", zero_points, n_channels)

        bad = ~np.isfinite(data)
        masked = _mask(mask, data.shape)
        if weights is not None and variance is not None:
            raise ValueError("weights and variance are both given: an observation takes one")
        messages = []
        if weights is not None:
            weights, no_weight = _weights(weights, data.shape)
        elif variance is not None:
            weights, no_weight = _inverse(variance, data.shape)
        else:
            weights, messages = _estimated(data, bad | masked, channels)
            no_weight = np.zeros_like(bad)
        n_bad = int(np.count_nonzero(~masked & (no_weight | (bad & (weights > 0)))))
        weights = np.where(bad | masked, 0.0, weights)
        if n_bad:
            messages.append(
                f"{n_bad} of {data.size} pixels have weight 0: no usable data, weight or variance"
            )
        messages += [
            f"channel {channel} has no pixel with a weight"
            for channel, seen in zip(channels, weights.any(axis=(1, 2)), strict=True)
            if not seen
        ]
        data = np.where(bad, 0.0, data)
        for array in (data, weights):
            array.flags.writeable = False
        for key, value in {
            "data": data,
            "psf": psf,
            "grid": grid,
            "weights": weights,
            "channels": channels,
            "zero_points": zero_points,
            "name": name,
            "n_bad": n_bad,
            "messages": tuple(messages),
        }.items():
            object.__setattr__(self, key, value)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, Ny, Nx)."""
        return self.data.shape

    @property
    def label(self) -> str:
        """What messages call this observation: its name, or else its channels."""
        return self.name or f"with channels {', '.join(self.channels)}"

    @property
    def flux_scale(self) -> np.ndarray | None:
        """Flux of one count (C,) [uJy]: 10^(-0.4 (zero_points - 23.9)); None without them."""
        if self.zero_points is None:
            return None
        return 10 ** (-0.4 * (self.zero_points - ZERO_POINT_UJY))


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


def _numbers(name, values):
    """As float64."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of real numbers: {error}") from None


def _channels(channels, name, n_channels):
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
    values = _numbers(name, values)
    if values.shape not in ((), (n_channels,)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be one finite number or {n_channels}, one for each channel, not {values}"
        )
    values = np.broadcast_to(values, n_channels).copy()
    values.flags.writeable = False
    return values


def _spread(name, values, shape):
    """Numbers given for each pixel, channel or all at once: (C, Ny, Nx)."""
    if values.shape == shape[:1]:
        return np.broadcast_to(values[:, None, None], shape)
    if values.shape not in ((), shape[1:], shape):
        raise ValueError(f"{name} has the shape {values.shape}, data {shape}")
    return np.broadcast_to(values, shape)


def _mask(mask, shape):
    if mask is None:
        return np.zeros(shape, dtype=bool)
    values = np.asarray(mask)
    if values.shape not in (shape[1:], shape):
        raise ValueError(f"mask has the shape {values.shape}, data {shape}")
    if values.dtype != bool and not np.isin(values, (0, 1)).all():
        odd = values[~np.isin(values, (0, 1))].flat[0]
        raise ValueError(
            f"mask must be True (ignore) or False, not {odd}: choose the bits that spoil a pixel"
        )
    return np.broadcast_to(values.astype(bool), shape)


def _weights(weights, shape):
    """Weights (C, Ny, Nx), and where they were NaN."""
    weights = _spread("weights", _numbers("weights", weights), shape)
    for wrong, what in ((weights < 0, "negative"), (np.isinf(weights), "infinite")):
        if wrong.any():
            raise ValueError(
                f"weights has {np.count_nonzero(wrong)} {what} values, the first at "
                f"(channel, y, x) = {tuple(np.argwhere(wrong)[0].tolist())}: "
                "a weight is an inverse variance, 0 to ignore a pixel"
            )
    lost = np.isnan(weights)
    return np.where(lost, 0.0, weights), lost


def _inverse(variance, shape):
    """Weights (C, Ny, Nx) from variances, and where these were no variance."""
    variance = _spread("variance", _numbers("variance", variance), shape)
    good = variance >= np.finfo(np.float64).tiny  # the inverse of less may overflow
    return np.divide(1.0, variance, out=np.zeros(shape), where=good), ~good


def _estimated(data, ignored, channels):
    """Weights (C, Ny, Nx) from each channel's own background, and what to tell about it."""
    weights, messages = np.ones(data.shape), []
    for i, channel in enumerate(channels):
        if ignored[i].all():
            continue  # no pixel of it will keep its weight
        try:
            sigma = noise_sigma(data[i], ignored[i])
        except ValueError as error:
            raise ValueError(f"channel {channel}: {error}; give weights or variance") from None
        weights[i] = sigma**-2
        messages.append(
            f"noise of channel {channel} estimated from the background: sigma = {sigma:.4g} counts"
        )
    return weights, messages
