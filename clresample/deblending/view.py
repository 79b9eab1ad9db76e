"""One observation ready to be fitted: its operator and data in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..device.rounding import round_up
from ..resampling.cache import cached_resampler
from ..resampling.resampler import Resampler
from ..sky.frame import Frame
from ..sky.mapping import Mapping
from ..sky.varying_psf.basis import PSFBasis
from .linear.ties import Ties

# Pixels of a model below this fraction of its brightest are set to 0 before rendering: their light
# is negligible, but in float32 they would become denormals, which are 20 times slower.
DENORMAL_FRACTION = 1e-20


@dataclass(frozen=True, eq=False)
class WhitenedView:
    """One observation ready to be fitted: its operator and whitened data.

    op: operator from the model frame to the observation, both padded if scenes share a batch; of T
        terms, see ResamplingPlan, if the PSF varies over the scene's sources
    mapping: that of op, but from the frame without padding
    covered (My, Mx): bool, whose centre lies on the frame itself
    noise_unit (Co,) [counts]: noise of a typical pixel of each channel, the unit of data and model
    sqrt_weights (Co, My, Mx) [1 / unit]: square root of the weights, 0 outside the frame
    data (Co, My, Mx) [unit]: the observation's data, 0 where the weight is 0
    coefficients (S, Co, T): of the op's terms in the PSF of each of the scene's sources; None where
        its PSF is the same for all
    noise (Co,) [unit]: of a typical pixel, where `noise_unit` is another one; None = 1
    ties: Ties of the channels of all views of the scene; None where each has a band of its own
    exposures (Co,): with ties, ratio of the band's total weight to that of this exposure
    sky_level (Co,) [unit]: expected level of the sky, subtracted from the data; 0 if unknown
    sky_precision (Co,) [1 / unit^2]: inverse variance of that expectation; 0 where unknown
        Both are None unless the sky is fitted.
    """

    op: Resampler
    mapping: Mapping
    covered: np.ndarray
    noise_unit: np.ndarray
    sqrt_weights: np.ndarray
    data: np.ndarray
    coefficients: np.ndarray | None = None
    noise: np.ndarray | None = None
    ties: Ties | None = None
    exposures: np.ndarray | None = None
    sky_level: np.ndarray | None = None
    sky_precision: np.ndarray | None = None

    @classmethod
    def of(cls, op, frame, data, weights, shares=None):
        """The view of an observation's data and weights (Co, My, Mx) on a model Frame.

        op: of the frame, or of a larger one that starts at the same pixel: pixels beyond the
            frame itself gets no weight; shares: see the class
        """
        unit = np.array([_typical_noise(channel) for channel in weights])
        mapping = replace(op.mapping, shape_in=frame.shape)
        covered = mapping.covered
        root = np.sqrt(weights) * unit[:, None, None] * covered
        data = np.where(root > 0, data, 0.0) / unit[:, None, None]
        return cls(op, mapping, covered, unit, root, data, shares)

    def with_model_error(self, error) -> WhitenedView:
        """The same view with a model whose own error (Co, My, Mx) [unit] adds to the noise.

        1/w = sigma^2 + error^2,  of pixels that have a weight
        """
        return replace(
            self, sqrt_weights=self.sqrt_weights / np.sqrt(1 + (self.sqrt_weights * error) ** 2)
        )

    def in_units(self, unit, ties) -> WhitenedView:
        """The same view with data and model in other units (Co,) [counts], and with Ties."""
        ratio = self.noise_unit / unit
        data = self.data * ratio[:, None, None]
        root = self.sqrt_weights / ratio[:, None, None]
        return replace(self, noise_unit=unit, sqrt_weights=root, data=data, noise=ratio, ties=ties)

    def expecting_sky(self, level, error) -> WhitenedView:
        """The same view with the sky at this level, with this Gaussian error, (Co,) [counts].

        The level is subtracted from the data, so that a fitted sky is the deviation from it. An
        infinite error means that the level is unknown.
        """
        level = level / self.noise_unit
        data = np.where(self.sqrt_weights > 0, self.data - level[:, None, None], 0.0)
        precision = (self.noise_unit / error) ** 2
        return replace(self, data=data, sky_level=level, sky_precision=precision)

    @cached_property
    def weights(self) -> np.ndarray:
        """Weights (Co, My, Mx) [1 / unit^2]."""
        return self.sqrt_weights**2

    @property
    def error_scale(self) -> np.ndarray:
        """Factor (Co,) of a model's own error beside the noise.

        The error is common to all exposures of a band, whose noise together is smaller by it.
        """
        return np.ones(len(self.data)) if self.exposures is None else np.sqrt(self.exposures)

    @property
    def pixel_noise(self) -> np.ndarray:
        """Noise (Co,) [unit] of one model pixel, if it were observed with the same exposure."""
        area = abs(np.linalg.det(self.mapping.matrix))
        return np.full(len(self.data), 1 if self.noise is None else self.noise) / np.sqrt(area)


def pixel_noise(views) -> np.ndarray:
    """Noise (C,) [unit] of one model pixel in each channel of a scene's views.

    Of tied channels that of all exposures of their band together.
    """
    noise, ties = np.concatenate([view.pixel_noise for view in views]), views[0].ties
    if ties is None:
        return noise
    seen = np.concatenate([(view.sqrt_weights > 0).any((1, 2)) for view in views])
    together = ties.spread(ties.total(np.where(seen, 1 / noise**2, 0)))
    return np.where(together > 0, 1 / np.sqrt(np.where(together > 0, together, 1)), noise)


def tied_views(views, observations):
    """Views of Observations.

    Where channels share a band, in units that are one flux density for all channels of it: the
    noise of their typical pixels, as if all had the mean weight.
    """
    names = [band for o in observations for band in o.bands]
    ties = Ties.of(names)
    if ties is None:
        return views
    unit = np.concatenate([view.noise_unit for view in views])
    scales = [o.flux_scale for o in observations]
    scale = np.ones(len(unit)) if scales[0] is None else np.concatenate(scales)
    seen = np.concatenate([(view.sqrt_weights > 0).any((1, 2)) for view in views])
    weight = ties.total(np.where(seen, (unit * scale) ** -2.0, 0))
    n = np.maximum(ties.total(seen), 1)
    common = np.where(weight > 0, np.sqrt(n / np.where(weight > 0, weight, 1)), scale[ties.first])
    unit = ties.spread(common) / scale
    ends = np.cumsum([len(view.data) for view in views])[:-1]
    views = [v.in_units(u, ties) for v, u in zip(views, np.split(unit, ends), strict=True)]
    noise = np.concatenate([view.pixel_noise for view in views])
    exposures = np.where(seen, (noise / pixel_noise(views)) ** 2, 1)
    parts = np.split(exposures, ends)
    return [replace(v, exposures=part) for v, part in zip(views, parts, strict=True)]


def flush_faint(images):
    """The images, in place, with DENORMAL_FRACTION pixels set to 0."""
    images[np.abs(images) < DENORMAL_FRACTION * np.abs(images).max(initial=0)] = 0
    return images


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """Model frame of a scene, padded frame, source positions, PSF tolerance; builds operators.

    frame: Frame; padded_frame: the same with its sides grown to those that a batch shares
    source_positions (S, 2) [px]: of the scene's sources in it; psf_tolerance: see Settings
    """

    frame: Frame
    padded_frame: Frame
    source_positions: np.ndarray
    psf_tolerance: float

    def operator(self, observation, grid, device, dtype, *, private):
        """Operator to a grid with an Observation's PSF at the places, and its coefficients.

        Coefficients (S, C, T) are None with one term, see WhitenedView; private: see
        `whitened_view`.
        """
        psf, n_terms, shares = observation.psf, 1, None
        if observation.psf_field is not None:
            basis = PSFBasis.of(observation.psf_field, self._on(observation), self.psf_tolerance)
            psf, n_terms = basis.psf, basis.n_terms
            shares = basis.coefficients if n_terms > 1 else None
        return cached_resampler(
            self.padded_frame,
            grid,
            psf,
            dtype=dtype,
            device=device,
            extent=self.frame.shape,
            private=private,
            n_terms=n_terms,
        ), shares

    def _on(self, observation):
        """The places (S, 2) in an Observation's pixels.

        Places outside move to the nearest pixel of the image, so that its PSF there needs no extra
        term.
        """
        at = self.frame.grid.positions_in(observation.grid, *self.source_positions.T)
        top = np.array(observation.data.shape[1:]) - 1
        return np.clip(np.where(np.isfinite(at), at, top / 2), 0, top)


def whitened_view(home, observation, pad, device, dtype, *, private) -> WhitenedView:
    """The view of an Observation on the frame of a SceneGeometry, padded to multiples of `pad`.

    Correlated noise is made white first (Observation.whitened).

    private: with an operator of its own, which may be shifted; else one that equal observations
        share
    """
    observation = observation.whitened
    shape = tuple(round_up(n, pad) for n in observation.data.shape[1:])
    grid = observation.grid
    if shape != observation.data.shape[1:]:
        grid = grid.cutout(0, 0, shape)
    op, shares = home.operator(observation, grid, device, dtype, private=private)
    data, weights = _padded(observation.data, shape), _padded(observation.weights, shape)
    return WhitenedView.of(op, home.frame, data, weights, shares)


def unfiltered_view(home, observation, view) -> WhitenedView:
    """The view of an Observation on the frame of a SceneGeometry, with the observation's own PSF.

    Where noise is correlated, the view has that of the white observation instead.
    """
    device, dtype = view.op.device, view.op.dtype
    op, shares = home.operator(observation, observation.grid, device, dtype, private=True)
    op.shift = view.op.shift
    return replace(view, op=op, coefficients=shares)


def _typical_noise(weights):
    """Median noise of the pixels that have a weight; 1 where none has."""
    seen = weights > 0
    return 1 / np.sqrt(np.median(weights[seen])) if seen.any() else 1.0


def _padded(images, shape):
    """Images (..., Ny, Nx) with zeros beyond, up to the last two of `shape`."""
    more = [(0, n - m) for n, m in zip(shape[-2:], images.shape[-2:], strict=True)]
    return np.pad(images, [(0, 0)] * (images.ndim - 2) + more)
