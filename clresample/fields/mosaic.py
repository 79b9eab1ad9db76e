"""One instrument's mosaic: images of any size, read in parts."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..deblending.inspection.spoilt import FLAT_SIGMAS
from ..sky.box import Box, outline
from ..sky.filled import filled_pixels
from ..sky.grid import Grid, as_grid
from ..sky.noise import NoiseWarning
from ..sky.observation import Observation
from ..sky.psf_checks import PSFWarning
from ..sky.validation.observed import as_psf
from ..sky.varying_psf.field import PSFField
from .background import Background, ConstantBackground
from .psfs.combined import ConstantPSF
from .strips import FilePlane as FilePlane  # beside the other kinds of Plane


class Plane(Protocol):
    """One plane (Ny, Nx) of an image."""

    def read(self, box) -> np.ndarray:
        """The pixels of a Box that lies on the image."""


@dataclass(frozen=True, eq=False)
class ArrayPlane:
    """A plane that is in memory."""

    array: np.ndarray

    def read(self, box) -> np.ndarray:
        """The pixels of a Box that lies on the image."""
        return self.array[box.slices]


@dataclass(frozen=True)
class ConstantPlane:
    """The same number in every pixel."""

    value: float

    def read(self, box) -> np.ndarray:
        """The pixels of a Box."""
        return np.full(box.shape, self.value)


@dataclass(frozen=True, eq=False)
class Channel:
    """One band of a mosaic.

    name: of the channel, unique over all mosaics
    data [counts]: plane of the image
    weight: plane, or None; weight_kind: what it holds, "weight" [counts^-2], "variance" [counts^2]
        or "rms" [counts], the standard deviation; 0, negative, NaN and infinite ones mean: ignore
        this pixel
    mask: plane or None; mask_value: the bits that mean: ignore this pixel; None = any that is not 0
    zero_point [mag]: AB magnitude of one count; None = unknown
    background: what is subtracted, or None
    saturation [counts]: of the plane's pixels, before the background is subtracted; None = unknown
    band: of which this is an exposure, see Observation; None = its own, `name`
    """

    name: str
    data: Plane
    weight: Plane | None = None
    weight_kind: str = "weight"
    mask: Plane | None = None
    mask_value: int | None = None
    zero_point: float | None = None
    background: Background | ConstantBackground | None = None
    saturation: float | None = None
    band: str | None = None

    def read(self, box) -> np.ndarray:
        """Pixels (Ny, Nx) [counts] of a Box, float64, the background subtracted if there is one."""
        data = np.asarray(self.data.read(box), dtype=np.float64)
        return data if self.background is None else data - self.background.read(box)

    def weights(self, box, masked=None) -> np.ndarray:
        """Inverse variances (Ny, Nx) [counts^-2] of a Box, 0 = ignore this pixel.

        masked (Ny, Nx): the result of `masked` for the Box, if it was computed before
        Raises ValueError for a channel without a plane of them.
        """
        if self.weight is None:
            raise ValueError(f"weight of channel {self.name!r} is None, must be a plane")
        values = np.asarray(self.weight.read(box), dtype=np.float64)
        if self.weight_kind == "weight":
            bad = ~np.isfinite(values) | (values < 0)
        else:
            variance = rms_squared(values) if self.weight_kind == "rms" else values
            good = (variance >= np.finfo(np.float64).tiny) & (variance < np.inf)  # no NaN is
            values = np.divide(1.0, variance, out=np.zeros(variance.shape), where=good)
            if self.mask is None:
                return values
            bad = ~good
        if self.mask is not None:
            bad = bad | (self.masked(box) if masked is None else masked)
        return np.where(bad, 0.0, values)

    def valid(self, box) -> np.ndarray:
        """Pixels (Ny, Nx) of a Box that mask and weights, where there are any, do not exclude."""
        return self.weights(box) > 0 if self.weight is not None else ~self.masked(box)

    def saturation_of(self, box) -> float:
        """Saturation level [counts] of the result of `read` on a Box; infinite where unknown.

        A subtracted background lowers it by its mean over the Box.
        """
        if self.saturation is None:
            return np.inf
        if self.background is None:
            return self.saturation
        left = self.saturation - float(self.background.read(box).mean())
        return left if left > 0 else np.inf

    @property
    def mask_key(self):
        """Equal for channels that ignore the same pixels."""
        return self.mask, self.mask_value

    def masked(self, box) -> np.ndarray:
        """Pixels (Ny, Nx) of a Box that the mask excludes; a channel without one excludes none."""
        if self.mask is None:
            return np.zeros(box.shape, bool)
        flags = np.nan_to_num(self.mask.read(box))
        return flags != 0 if self.mask_value is None else _set(flags, self.mask_value)


def rms_squared(values):
    """Variances of standard deviations; negative ones, which mean that there are no data, stay so.

    values: array
    """
    return values * np.abs(values)


@dataclass(frozen=True, eq=False)
class Mosaic:
    """One instrument's mosaic of a field.

    name: of the instrument; grid: Grid of (Ny, Nx) of all channels, or a WCS with a shape
    channels: of Channel, at least one
    psf: PSFField, PSF or its images, of one band or of one for each channel
    noise: correlation of neighbouring pixels' noise, as in Observation, or None. An estimate must
        be made before, once for the whole mosaic
    """

    name: str
    grid: Grid
    channels: tuple[Channel, ...]
    psf: PSFField
    noise: object = None

    def __post_init__(self):
        object.__setattr__(self, "grid", as_grid("grid", self.grid))
        if not isinstance(self.psf, PSFField):
            object.__setattr__(self, "psf", ConstantPSF(as_psf("psf", self.psf)))
        if not self.channels:
            raise ValueError(f"channels of mosaic {self.name!r} is empty, at least one is needed")
        if self.psf.n_bands not in (1, len(self.channels)):
            raise ValueError(
                f"psf of mosaic {self.name!r} has {self.psf.n_bands} bands, channels are "
                f"{len(self.channels)}: give one band, or one for each channel"
            )
        known = [c.zero_point is not None for c in self.channels]
        if any(known) and not all(known):
            raise ValueError(
                f"zero_point of channel {self.channels[known.index(False)].name!r} is missing: "
                "give all or none"
            )

    @classmethod
    def of_arrays(
        cls,
        name,
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
        saturation=None,
        unit=None,
    ) -> Mosaic:
        """A mosaic of arrays in memory, from the arguments of an Observation, by its checks.

        name: of the instrument; the others: see Observation, which also estimates missing noise
        """
        o = Observation(
            data,
            psf,
            grid,
            weights=weights,
            variance=variance,
            mask=mask,
            channels=channels,
            bands=bands,
            zero_points=zero_points,
            noise=noise,
            name=name,
            saturation=saturation,
            unit=unit,
        )
        n = len(o.channels)
        levels = [np.inf] * n if o.saturation is None else o.saturation.tolist()
        points = [None] * n if o.zero_points is None else o.zero_points.tolist()
        made = tuple(
            Channel(
                o.channels[i],
                ArrayPlane(o.data[i]),
                ArrayPlane(o.weights[i]),
                zero_point=points[i],
                saturation=levels[i] if np.isfinite(levels[i]) else None,
                band=None if bands is None else o.bands[i],
            )
            for i in range(n)
        )
        psf_field = psf if isinstance(psf, PSFField) else ConstantPSF(o.psf)
        return cls(name, o.grid, made, psf_field, o.noise)

    def box_on(self, grid) -> Box:
        """The pixels of this mosaic whose centres may lie on a grid: a Box on the mosaic.

        Its area is 0 without any.
        """
        there = self.edge_of(grid)
        if not len(there):
            return Box(0, 0, 0, 0)
        return Box.around(there).grown(1).intersection(Box.of(self.grid.shape))

    def edge_of(self, grid) -> np.ndarray:
        """Points (n, 2) [px] along the outer edge of a grid that lie in the mosaic's projection."""
        there = grid.positions_in(self.grid, *outline(grid.shape))
        return there[np.isfinite(there).all(axis=-1)]

    def observation(
        self, box=None, *, ignore=None, subtract=None, extra=None, psf_box=None, grid=None
    ) -> Observation | None:
        """The Observation of a Box that lies on the mosaic; None where no pixel has a weight.

        box: None = all of the mosaic
        ignore (Ny, Nx) bool: pixels that get no weight
        subtract (C, Ny, Nx) [counts]: light that is not to be fitted
        extra (C, Ny, Nx) [counts^2]: variance that is added to the pixels'
        psf_box: Box in whose middle the PSF is evaluated, for the whole Observation; None = it
            varies as the mosaic's does
        grid: Grid of the Box, if it exists already
        """
        box = box or Box.of(self.grid.shape)
        weights = self._weights(box)
        if ignore is not None:
            weights[:, ignore] = 0
        if not weights.any():
            return None
        data = np.stack([np.asarray(c.data.read(box), np.float64) for c in self.channels])
        for c, image, w in zip(self.channels, data, weights, strict=True):
            if subtract is not None or isinstance(c.background, Background):
                w[filled_pixels_of(image, w)] = 0  # not of one value afterwards
            if c.background is not None:
                image -= c.background.read(box)
        if not weights.any():
            return None
        if subtract is not None:
            data = data - subtract
        if extra is not None:
            weights = weights / (1 + weights * extra)
        zero_points = [c.zero_point for c in self.channels]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)  # issued once, when the field is opened
            warnings.simplefilter("ignore", NoiseWarning)  # a Box may lie in a hole of the data
            psf = self.psf.cutout(box.y0, box.x0) if psf_box is None else self._middle(psf_box)
            return Observation(
                data,
                psf,
                grid or self.grid.cutout(box.y0, box.x0, box.shape),
                weights=weights,
                channels=tuple(c.name for c in self.channels),
                bands=tuple(c.band or c.name for c in self.channels),
                zero_points=None if zero_points[0] is None else zero_points,
                noise=self.noise,
                name=self.name,
                saturation=saturations(self.channels, box),
            )

    def _weights(self, box):
        """Weights (C, Ny, Nx) of all channels on a Box; a mask that several share is read once."""
        masked = {key: c.masked(box) for key, c in {c.mask_key: c for c in self.channels}.items()}
        return np.stack([c.weights(box, masked[c.mask_key]) for c in self.channels])

    def _middle(self, box):
        """The PSF in the middle of a Box."""
        return self.psf.psf_at(*((np.array(box[:2]) + np.array(box[2:]) - 1) / 2))


def saturations(channels, box) -> np.ndarray | None:
    """Saturation levels (C,) [counts] of channels on a Box; None where none of them has one."""
    if all(c.saturation is None for c in channels):
        return None
    return np.array([c.saturation_of(box) for c in channels])


def filled_pixels_of(image, weights) -> np.ndarray:
    """Pixels (Ny, Nx) bool of a plane that are filled with a value: no data.

    An image of one value is filled; flat tops of saturated stars are not, see `FLAT_SIGMAS`.
    """
    usable = (weights > 0) & np.isfinite(image)
    values = image[usable]
    if values.size and (values == values[0]).all():
        return usable
    filled = filled_pixels(image, usable, weights)
    return filled & ~(np.where(filled, image, 0) * np.sqrt(weights) > FLAT_SIGMAS)


def _set(flags, bits):
    """Pixels with any of the bits; flags of any integer type."""
    return (np.asarray(flags).astype(np.int64) & bits) != 0
