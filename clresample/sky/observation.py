"""An instrument's image of a patch of sky: pixels, weights, PSF and grid."""

from __future__ import annotations

import copy
import operator
from dataclasses import dataclass

import numpy as np

from ..drawing.display import ObservationDisplay
from .correlation import NoiseCorrelation, channel_correlations
from .grid import Grid
from .noise import weights_from
from .psf import PSF
from .validation.checks import ReadOnly, check_sequence, described
from .validation.containers import arguments_of, is_container
from .validation.derived import ZERO_POINT_UJY as ZERO_POINT_UJY, DerivedQuantities
from .validation.observed import (
    bands_of,
    channels_of,
    images_of,
    per_channel,
    psfs_of,
    saturation_of,
)
from .validation.units import flux_unit, take_unit, zero_points_of
from .varying_psf.field import PSFField


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Observation(ReadOnly, ObservationDisplay, DerivedQuantities):
    """Images of one instrument, one per channel, on one pixel grid.

        chi2 = sum weights (model - data)^2

    data (C, Ny, Nx) [counts per pixel]: background-subtracted images; (Ny, Nx) is one channel. The
        attribute is float64, with 0 in place of NaN and infinite pixels. A Quantity of counts or
        of flux density per pixel (data * u.nJy) keeps its unit: see `unit`
    psf: PSF of C bands, pixel response included; one band serves all channels. Or its images, an
            array accepted by `PSF`. Or a PSFField: fits render each source with the PSF at its
            position
    grid: Grid of (Ny, Nx), or the WCS of these pixels, of astropy or gwcs
    weights [counts^-2]: inverse variance, 0 = ignore this pixel; or, instead of it,
    variance [counts^2]: NaN, infinite, zero and negative ones mean: ignore this pixel. Weights and
        variances are (C, Ny, Nx), or (Ny, Nx) for all channels, (C,) or one number for all pixels,
        or a list of C of these, None where a channel's noise is to be estimated
    mask (C, Ny, Nx) or (Ny, Nx): True = ignore this pixel; may come with either of the two or
        alone. Masks of masked arrays among data, weights and variance mean the same
    channels (C,): names, unique over all instruments; None numbers them after `name`
    bands (C,): names of the channels' bands; channels of one band, here or in other observations
        of a fit, are exposures of it and have one spectrum, by the ratio of their zero points.
        None = each channel's own name
    zero_points (C,) or one number [mag]: AB magnitude of one count
    noise: correlation of the noise of neighbouring pixels, in drizzled, resampled and stacked
        images: a NoiseCorrelation, or its autocorrelation (2L + 1, 2L + 1), for all channels, or C
        of these, or "estimate" from blank sky. None = white. Weights stay those of single pixels
    name: of the instrument, for messages
    saturation (C,) or one number [counts]: values of data from which on pixels are saturated,
        infinite where unknown; None = unknown in all channels
    unit: of data without one of their own, an astropy unit or its name. A flux density sets
        zero_points, and is the unit of the catalogue's fluxes where all observations have it

    Without weights and variance the noise of each channel is estimated from the scatter of the
    background (`noise_sigma`), as one number without the photon noise of sources, and a
    NoiseWarning is issued, as of images without any usable pixel.

    Attributes: data and weights (C, Ny, Nx) float64; psf of C bands, that in the middle of the
    image; psf_field of C bands if the PSF varies, else None; zero_points and noise (C,) or None;
    n_invalid, the number of unmasked pixels with weight 0 because of invalid data, weight or
    variance; messages; saturation (C,) or None; unit, a flux density, or None for counts

    Raises ValueError for shapes that disagree, negative or infinite weights, masks with values
    other than 0 and 1, repeated names, weights together with variance, noise that cannot be
    estimated, incompatible units, and values that are not real numbers.
    """

    data: np.ndarray
    psf: PSF
    psf_field: PSFField | None
    grid: Grid
    weights: np.ndarray
    channels: tuple[str, ...]
    bands: tuple[str, ...]
    zero_points: np.ndarray | None
    noise: tuple[NoiseCorrelation, ...] | None
    name: str | None
    saturation: np.ndarray | None
    unit: object
    n_invalid: int
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
        bands=None,
        zero_points=None,
        noise=None,
        name=None,
        saturation=None,
        unit=None,
    ):
        if is_container(data):
            raise ValueError(
                f"data is of type {type(data).__name__}: give Observation.from_nddata(image, psf)"
            )
        data, unit = take_unit(data, unit)
        flux = flux_unit(unit)
        data, mask, grid = images_of(data, grid, mask)
        psfs = psfs_of(psf, data.shape)
        bad = ~np.isfinite(data)
        channels = channels_of(channels, name, len(data))
        given = weights, variance
        weights, n_invalid, messages = weights_from(data, bad, given, mask, channels, unit)
        zero_points = per_channel("zero_points", zero_points, len(data))
        data = np.where(bad, 0.0, data)
        noise, found = channel_correlations(noise, data, weights, channels)
        messages += found
        self._set(
            data=data,
            **psfs,
            grid=grid,
            weights=weights,
            channels=channels,
            bands=bands_of(bands, channels),
            zero_points=zero_points_of(flux, zero_points, len(data)),
            noise=noise,
            name=name,
            saturation=saturation_of(saturation, len(data), unit),
            unit=flux,
            n_invalid=n_invalid,
            messages=tuple(messages),
        )

    def _set(self, **values):
        """The fields, images made read-only."""
        for key, value in values.items():
            if key in ("data", "weights"):
                value.flags.writeable = False
            object.__setattr__(self, key, value)

    @classmethod
    def from_nddata(cls, image, psf=None, **given) -> Observation:
        """An Observation of an astropy NDData, CCDData or Cutout2D.

        image: its data (Ny, Nx) or (C, Ny, Nx), unit, wcs, mask (True = ignore) and uncertainty
            (standard deviation, variance or inverse variance); a Cutout2D has data and wcs only
        psf: as for Observation; None = that of the image, which a CCDData may have
        given: more arguments of Observation (weights, variance, mask, ...), instead of the image's

        Raises ValueError for an image without a WCS or a PSF, with an uncertainty of another kind,
        and as Observation does.
        """
        return cls(**arguments_of(image, psf, given))

    @classmethod
    def restore(cls, data, psf, grid, *, weights, n_invalid, messages, **given) -> Observation:
        """Restores an observation from values read back.

        n_invalid and messages are those of the original. Raises ValueError as the constructor does.
        """
        restored = cls(data, psf, grid, weights=weights, **given)
        restored._set(n_invalid=int(n_invalid), messages=tuple(messages))
        return restored

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, Ny, Nx)."""
        return self.data.shape

    @property
    def label(self) -> str:
        """Name of this observation in messages: its name, or else its channels."""
        return self.name or f"with channels {', '.join(self.channels)}"


def masked(observation, pixels) -> Observation:
    """The same observation with the pixels (C, Ny, Nx) bool masked: their weight is 0."""
    return with_weights(observation, np.where(pixels, 0.0, observation.weights))


def with_weights(observation, weights) -> Observation:
    """The same observation with these weights (C, Ny, Nx) [counts^-2]."""
    return _changed(observation, weights=weights)


def with_data(observation, data) -> Observation:
    """The same observation with these data (C, Ny, Nx) [counts]."""
    return _changed(observation, data=data)


def with_psf_field(observation, psf_field) -> Observation:
    """The same observation with the PSFs of a PSFField; its PSF in the middle stays."""
    return _changed(observation, psf_field=psf_field)


def _changed(observation, **values):
    """A copy with other fields, without what is cached for the old ones."""
    made = copy.copy(observation)
    made.__dict__.pop("whitened", None)
    made._set(**values)
    return made


def as_observations(observations) -> tuple[Observation, ...]:
    """Observations from a list that may hold astropy's images, NDData or CCDData with a PSF.

    Images are named by their place in the list, image0 and so on. Anything else is left as it is.
    Raises ValueError for one observation instead of a list, and for images without a WCS or a PSF.
    """
    if isinstance(observations, Observation) or is_container(observations):
        raise ValueError("observations is a single one, must be a sequence: give [observation]")
    try:
        observations = tuple(observations)
    except TypeError:
        raise ValueError(
            f"observations is {described(observations)}, must be a sequence of Observation"
        ) from None
    return tuple(
        Observation.from_nddata(o, name=f"image{i}") if is_container(o) else o
        for i, o in enumerate(observations)
    )


def observation_index(observations, key) -> int:
    """Index of an observation, from its index or name (or label, if it has no name).

    Raises ValueError for a name that none of them or several have, and for another number.
    """
    n = len(observations)
    if not isinstance(key, str):
        i = operator.index(key)
        if not -n <= i < n:
            raise ValueError(f"observation is {i}, must be a number below {n} or a name")
        return i % n
    found = [i for i, o in enumerate(observations) if key in (o.name, o.label)]
    if len(found) == 1:
        return found[0]
    labels = ", ".join(repr(o.label) for o in observations) or "none"
    how_many = "no observation has" if not found else f"{len(found)} observations have"
    raise ValueError(f"observation is {key!r}, but {how_many} this name: given are {labels}")


def check_observations(observations):
    """Raises ValueError unless these observations can be fitted together.

    There must be at least one; channel names must be unique; all or none must have zero points; and
    their grids must be all flat or all placed by a WCS.
    """
    if not observations:
        raise ValueError("observations is empty, at least one is needed")
    check_sequence("observations", observations, Observation)
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
