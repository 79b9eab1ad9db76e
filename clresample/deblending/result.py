"""The fitted model of one blend, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..drawing.display import ResultDisplay
from ..sky.box import box_slices
from ..sky.footprint import Footprint, unobserved
from ..sky.frame import Frame
from ..sky.observation import Observation, observation_index
from ..sky.sources import Source
from ..sky.validation.checks import check_integer
from .assessment.misfit import Misfit, misfit_of
from .component_images import ComponentImages, source_image
from .ended import Ended
from .posterior.errors import Errors, PosteriorSampler
from .posterior.sampling import drawn_components, drawn_fluxes
from .solver.scene_model import compose


@dataclass(frozen=True, eq=False, repr=False)
class Component:
    """One spectrum times one morphology.

    source: index of the source it belongs to
    origin (2,) [px]: (y, x) of the box's first pixel in the model frame; the box lies inside it
    morphology (ny, nx) [1]: max = 1, under the model's PSF
    spectrum (C,) [counts]: flux per model pixel where the morphology is 1, over all channels of all
        observations in their order, each in its own observation's counts; 0 in a channel without
        any data. Where a flux is NaN (`fluxes`) it describes no more than the wings on its pixels

    The covariance of all spectra is Result.covariance.
    """

    def __repr__(self):
        n_y, n_x = self.morphology.shape
        return f"Component(of source {self.source}, {n_y} x {n_x} px from {tuple(self.origin)})"

    source: int
    origin: tuple[int, int]
    morphology: np.ndarray
    spectrum: np.ndarray

    @property
    def flux(self) -> np.ndarray:
        """Total flux (C,) [counts] in the box."""
        return self.spectrum * self.morphology.sum()


@dataclass(frozen=True, eq=False, repr=False)
class Result(ResultDisplay):
    """The fitted model of one blend.

    observations, frame, sources: the input of the fit; positions of sources in an observation's
        pixels were converted to the frame's; components (n): in the order of the sources
    rendered: per observation the ComponentImages (n, Co, My, Mx) [1] of each component's morphology
        on its pixels under its PSF: spectrum times this is the model of the data. Made of arrays,
        where these are given
    sky (C,) [counts]: constant background per channel, 0 where it was not fitted
    covariance (C, n, n) [counts^2]: of the spectra of one channel over all components, inverse of
        the normal matrix with morphologies fixed (and sky free where it was); infinite variance for
        components without coverage
    errors: of fits with a MultiscalePrior, the Errors of fluxes, shapes and morphologies,
        marginalised over the morphologies, which `fluxes` and `catalogue` report. None for other
        priors, and if they failed, with a reason in `messages`; then these report the covariance
        above
    draws: PosteriorSampler of `sample` and `sample_fluxes`
    shifts (n_observations, 2) [model px]: fitted offsets of the observations' pixels
    psf_error [1]: of the fit's Settings; chi2 of `misfit` counts it as noise in the light of stars
    losses (n_iterations + 1,): half chi2 (plus priors) before each iteration and at the end
    status: an Ended, which compares as its text: "converged", "misfit" (its steps ended, but the
        model does not describe the data, see `Misfit.is_wrong`), "iteration limit", "diverged" or
        "interrupted"
    unlisted: peaks of light that no source is listed for, (observation, y [px], x [px]) each
    thetas (S): of each source a tuple of its components' parameters (n,), of the smooth profiles
        from which the fit began; another fit of these sources may start from them, see Blend. ():
        of a result that was read
    structures (S): of each source a tuple of its components' ComponentStructures, None for fixed
        ones; another fit of these sources may go on from them too. (): of other priors, and of a
        result that was read
    messages: for the user, a line each; seconds: wall time by stage
    """

    observations: tuple[Observation, ...]
    frame: Frame
    sources: tuple[Source, ...]
    components: tuple[Component, ...]
    rendered: tuple[ComponentImages, ...]
    sky: np.ndarray
    covariance: np.ndarray
    shifts: np.ndarray
    losses: np.ndarray
    status: Ended
    errors: Errors | None = None
    draws: PosteriorSampler | None = None
    thetas: tuple = ()
    structures: tuple = ()
    psf_error: float = 0.0
    unlisted: tuple = ()
    messages: tuple[str, ...] = ()
    seconds: dict = field(default_factory=dict)

    def __post_init__(self):
        images = tuple(map(ComponentImages.of, self.rendered))
        object.__setattr__(self, "rendered", images)

    def __getstate__(self):
        """Attributes for pickles and copies, without what is large and derived in no time."""
        return {name: x for name, x in vars(self).items() if name not in _LARGE}

    @property
    def converged(self) -> bool:
        """True if the fit converged to a model that describes the data."""
        return self.status == Ended.CONVERGED

    @property
    def channels(self) -> tuple[str, ...]:
        """Names (C,) of all channels, in the order of the spectra."""
        return tuple(name for o in self.observations for name in o.channels)

    @property
    def bands(self) -> dict[str, int]:
        """The bands of all channels by name, each with the number of its first channel."""
        names = [band for o in self.observations for band in o.bands]
        return {name: names.index(name) for name in dict.fromkeys(names)}

    @cached_property
    def footprints(self) -> tuple[Footprint, ...]:
        """Footprints of the observations in the frame, at their fitted shifts."""
        return tuple(
            Footprint(o, o.grid.map_to(self.frame.grid), np.asarray(shift, np.float64))
            for o, shift in zip(self.observations, self.shifts, strict=True)
        )

    @cached_property
    def unobserved(self) -> np.ndarray:
        """Unobserved pixels (Ny + 2, Nx + 2) bool of the frame and its border."""
        return unobserved(self.footprints, self.frame.shape)

    @cached_property
    def misfit(self) -> Misfit:
        """Residual light of the model, source by source and channel by channel."""
        return misfit_of(self)

    def index_of(self, observation) -> int:
        """The number of an observation, given by its number or name; ValueError for others."""
        return observation_index(self.observations, observation)

    def channel_slices(self) -> list[slice]:
        """For each observation, its part of a spectrum."""
        ends = np.cumsum([len(o.channels) for o in self.observations])
        return [
            slice(end - len(o.channels), end)
            for o, end in zip(self.observations, ends, strict=True)
        ]

    def source_model(self, i_source, i_observation=None) -> np.ndarray:
        """One source (C, Ny, Nx) in the model frame, or (Co, My, Mx) rendered in an observation.

        i_observation: number or name of the observation; None = the model frame
        """
        if i_observation is None:
            parts = [c for c in self.components if c.source == i_source]
            spectra = np.array([c.spectrum for c in parts]).reshape(-1, len(self.channels))
            origin, morphs = [c.origin for c in parts], [c.morphology for c in parts]
            return compose(self.frame.shape, origin, morphs, spectra)
        i_observation = self.index_of(i_observation)
        shape = self.observations[i_observation].data.shape
        image = source_image(self, i_source, i_observation, box_slices((0, 0), shape[1:]))
        return np.zeros(shape) if image is None else image

    def as_galsim(self, i_source, channel):
        """One source as a GalSim object: galsim.InterpolatedImage, under the frame's PSF.

        i_source: its number; channel: a name, or a number in the order of `channels`
        returns the profile about the source's position [arcsec, u to the west, v to the north],
            with its flux in that channel's counts; `galsim.Deconvolve` takes the frame's PSF off

        Raises ImportError without GalSim; ValueError for an unknown channel.
        """
        from ..adapters.galsim import profile_of

        if isinstance(channel, str):
            if channel not in self.channels:
                raise ValueError(f"channel is {channel!r}, must be one of {self.channels}")
            channel = self.channels.index(channel)
        position = self.frame.positions_of(self.sources)[i_source]
        return profile_of(self.source_model(i_source)[channel], self.frame.grid, position)

    def model(self, i_observation) -> np.ndarray:
        """All sources and the sky (Co, My, Mx) [counts], rendered in an observation.

        i_observation: its number or name
        """
        i_observation = self.index_of(i_observation)
        channels = self.channel_slices()[i_observation]
        n_channels = channels.stop - channels.start
        spectra = np.array([c.spectrum[channels] for c in self.components]).reshape(-1, n_channels)
        image = self.rendered[i_observation].total(spectra)
        return image + self.sky[channels, None, None]

    def residual(self, i_observation) -> np.ndarray:
        """Data minus model (Co, My, Mx) [counts]; NaN where the data have no weight."""
        o = self.observations[self.index_of(i_observation)]
        return np.where(o.weights > 0, o.data - self.model(i_observation), np.nan)

    def cutout(self, source, observation, what="data", *, size=None, unit=None):
        """One source, or several as one, without its neighbours, in an observation's own pixels.

        source: a number, a name, or a sequence of these: a group that is cut out as one
        observation: a number, an observation's name, or a channel's name for that channel alone
        what: "data", minus the sky and the models of all other sources; "model", of the source;
            "residual", data minus all models; "neighbours", the model of all others; or
            "redistributed", the source's share of the data in proportion to the models, see
            `redistribute`. "data" is "model" plus "residual"
        size: (ny, nx) or one number of pixels, or angles as Quantities, about the source; None =
            the extent of its model down to a tenth of the noise, within the image
        unit: None = counts, or one of flux density, such as "uJy", which requires zero points

        returns astropy.nddata.CCDData (Ny, Nx), or (C, Ny, Nx) of several channels: with the WCS,
            the standard deviation (of "data": noise and what the posterior leaves open of the
            neighbours, see docs/howto/alone.md), mask (True = ignore: no data, or outside), and the
            PSF at the middle. Images of data are NaN where they are masked

        Raises ValueError for unknown names, invalid sizes, a source outside of the observation, and
        units without zero points.
        """
        from .cutouts.cutout import cutout  # 0.1 s of astropy, not needed by fits

        return cutout(self, source, observation, what, size=size, unit=unit)

    def sample(self, n, rng=None) -> list[tuple[Component, ...]]:
        """Draws n sets of components from the posterior about the solution, as `errors` has it.

        rng: NumPy Generator, or a seed: equal seeds give equal draws, also of a result read from a
            file.

        Draws differ from the catalogue's errors in these ways. Morphologies and spectra below 0 are
        set to 0, so that faint sources are brighter in the mean; pixels at that bound stay at 0.
        Morphologies keep their scale, so that their maximum is no longer 1. Misfitted sources have
        a larger scatter, as in Errors. Fluxes scatter about those of the components, not about
        those of `fluxes` and the catalogue, which include Errors.flux_correction.
        Settings.flux_error_floor and light beyond the boxes are not included, so that fluxes of
        faint sources scatter by up to a tenth less than in `errors`. For misfitted sources at
        positions where light was missed the bound at 0 reduces the scatter by up to 0.4, because
        their changes are as large as their morphologies.

        Raises ValueError for results without draws: of other priors, or without errors.
        """
        rng = np.random.default_rng(rng)
        return [drawn_components(self, rng) for _ in range(check_integer("n", n))]

    def sample_fluxes(self, n, rng=None) -> np.ndarray:
        """Draws the sources' fluxes (n, S, C) [counts] from the posterior, n times.

        They scatter about the catalogue's fluxes as its errors say, to first order like these,
        without the bounds of `sample`: those of faint sources may be below 0. NaN if not measured.
        So they include light beyond the boxes, Settings.flux_error_floor, and what is open of the
        division of light between neighbours (posterior/shared_light.py), of size and wings of faint
        galaxies (start/shape_grid.py), and of the PSF's width (assessment/psf_width.py). Errors of
        the catalogue are larger where they include light outside the images, a saturated core, or
        the light of a star beside them.

        rng: NumPy Generator, or a seed

        Raises ValueError as `sample` does.
        """
        return drawn_fluxes(self, check_integer("n", n), np.random.default_rng(rng))


# Cached properties of a Result that do not depend on its status, messages, errors or draws.
_LARGE = "footprints", "unobserved"
_DERIVED = *_LARGE, "misfit"


def noted(result, **given) -> Result:
    """A copy with another status, other messages, errors or draws, and what was derived before."""
    copy = replace(result, **given)
    vars(copy).update((name, vars(result)[name]) for name in _DERIVED if name in vars(result))
    return copy
