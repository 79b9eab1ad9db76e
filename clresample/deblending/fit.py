"""The fit of one blend: views of its observations, start, scene, result."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np

from ..device.rounding import round_up
from ..resampling.transfer import floor_warnings
from ..sky.frame import Frame
from .component_images import ComponentImages
from .ended import Ended
from .inspection.inspect import inspect
from .linear.rendered_models import MorphologyModel, RenderedModel, render_models
from .posterior.posterior import with_errors
from .result import Component, Result
from .solver.scene import ComponentStructure, image_numbers, signature_of
from .start.carried_structure import carry_structure
from .start.first_scene import first_scene
from .start.profile_start import (
    LIGHT_SIGMAS,
    StartingPoint,
    StartInput,
    fit_start_profiles,
    with_psf_error_weights,
)
from .view import SceneGeometry, pixel_noise, tied_views, unfiltered_view, whitened_view


class Fit:
    """The fit of one blend, from its data to its Result.

    blend, settings, frame: as `inspect` returns them
    problems (n,): messages of that inspection; sky_levels: SkyLevel of each observation
    given (S,): bool, sources that are as they were listed
    unlisted: peaks without a source, see Result
    sources: the blend's, with positions in the frame's pixels where an observation's were given
    fitted (n,): indices of those inside the frame; undetected (n_dark,): of those far from any
        light
    views: the observations as WhitenedViews, whose operators hold the observations' shifts
    noise (C,): of one model pixel, in the views' units; unit (C,) [counts]: these units
    ties: Ties of the channels, or None
    padded: the frame with its sides grown to those that a batch shares; geometry: SceneGeometry
    last_steps (n_observations, 2) [model px]: last steps of the shifts, before `extrapolate`
    start: the StartingPoint passed to `begin`, which sets the following
    scene, state: Scene and State at the start, later those of `end`
    strength_estimates: those of a MultiscalePrior, or None; losses, status, messages, seconds: see
        Result
    kept_fluxes: some (n, C) on the way, see assessment/unsettled.py
    """

    def __init__(self, blend, settings, device, dtype, *, pad):
        began = time.perf_counter()
        self.frame = blend.resolve_frame()
        shifts = blend.initial_shifts()
        positions = self.frame.positions_of(blend.sources, blend.observations, shifts)
        found = inspect(blend, self.frame, positions, shifts, settings)
        given, blend, settings, shifts = blend, found.blend, found.settings, found.shifts
        positions = self.frame.positions_of(blend.sources, blend.observations, shifts)
        inside, outside = _inside(self.frame, positions, blend.sources)
        pairs = zip(blend.sources, positions, strict=True)
        self.sources = tuple(source.on_frame(position) for source, position in pairs)
        self.blend, self.settings = blend, settings
        self.problems, self.sky_levels = found.messages, found.levels
        self.unlisted = found.unlisted
        self.messages, self.fitted = outside + self.problems, np.flatnonzero(inside)
        pairs = zip(blend.sources, given.sources, strict=True)
        self.given = np.array([one is other for one, other in pairs], bool)
        padded, private = _padded_frame(self.frame, pad), settings.fit_shifts or shifts.any()
        self.geometry = SceneGeometry(
            self.frame, padded, positions[self.fitted], settings.psf_tolerance
        )
        view = partial(whitened_view, pad=pad, device=device, dtype=dtype, private=private)
        views = [view(self.geometry, o) for o in blend.observations]
        self.views = tied_views(views, blend.observations)
        if settings.fit_sky:
            pairs = zip(self.views, self.sky_levels, strict=True)
            self.views = [view.expecting_sky(sky.level, sky.error) for view, sky in pairs]
        self.ties = self.views[0].ties
        if private:
            self.shift(shifts)
        for o, view in zip(blend.observations, self.views, strict=True):
            # models have no noise to amplify
            self.messages += [f"{o.label}: {line}" for line in floor_warnings(view.op.certificate)]
        if not any(view.sqrt_weights.any() for view in self.views):
            raise ValueError(
                "no observed pixel on the model frame has a weight: check data, weights and "
                "variance for NaN and 0, the mask, and that the frame covers the images"
            )
        self.unit = np.concatenate([view.noise_unit for view in self.views])
        self.noise = pixel_noise(self.views)
        self.padded, self._positions, self.start = padded, positions, None
        self._whitened = self.views, tuple(self.messages)
        self.seconds = {"setup": time.perf_counter() - began}

    @property
    def patch(self) -> StartInput:
        """Inputs of the start of this fit."""
        i = self.fitted
        thetas = self.blend.thetas if len(self.blend.thetas) else [None] * len(self.sources)
        sources, thetas = ([some[k] for k in i] for some in (self.sources, thetas))
        positions, observations = self._positions[i], self.blend.observations
        given = tuple(np.flatnonzero(self.given[i]).tolist())
        return StartInput(
            self.frame, sources, positions, self.views, tuple(thetas), observations, given
        )

    @property
    def signature(self):
        """Fits of equal signature start and iterate side by side, see `signature_of`."""
        ops = [view.op for view in self.views]
        known = signature_of(self.padded.shape, self.settings.fit_sky, ops, self.ties)
        return known, self.settings.fit_shifts

    def forget_start(self):
        """Restores weights and messages as they were before a start, which may have failed."""
        self.views, self.messages = self._whitened[0], list(self._whitened[1])

    def begin(self, point: StartingPoint, seconds):
        """Makes the scene and its state from the starting point; seconds: the time of the start."""
        began = time.perf_counter()
        self.views, self.start = with_psf_error_weights(self.patch, point, self.settings)
        self.undetected = self.fitted[point.undetected]
        self.messages += [_dark_message(i, self._positions[i]) for i in self.undetected]
        self.messages += [self._wide_message(i, gain) for i, gain in point.not_points.items()]
        self._first_shifts, self._going_on = self.shifts, None
        self.restart()
        self.seconds["setup"] += seconds + time.perf_counter() - began

    def _wide_message(self, i_fitted, gain):
        """Message about a point source that is better as a galaxy, by a gain in chi2."""
        i = self.fitted[i_fitted]
        is_free = self.sources[i].free_position
        return (
            f"a point source is wider than the PSF{'' if is_free else ', or lies elsewhere'}: with "
            f"a galaxy in the place of source {i}, chi2 is lower by {gain:.0f}; the errors of "
            "fluxes hold the difference; list it as an ExtendedSource"
            f"{'' if is_free else ', or give free_position=True'}"
        )

    def go_on_from(self, state):
        """Replaces the state at the start, here and in `restart`; None: that of the profiles."""
        self.state = self._going_on = state

    def restart(self):
        """Restores the state of the fit at the end of `begin`."""
        self.shift(self._first_shifts)
        self.scene, self.state = first_scene(self)
        self.state = self._going_on or self.state
        self.losses, self.status, self.strength_estimates = [], Ended.LIMIT, None
        self.kept_fluxes: list[np.ndarray] = []
        self.last_steps = np.zeros_like(self.shifts)

    @property
    def sky_level(self) -> np.ndarray:
        """Level (C,) of the sky that is taken off the views' data, in their units."""
        return _joined([view.sky_level for view in self.views], len(self.unit))

    @property
    def sky_precision(self) -> np.ndarray:
        """Inverse variance (C,) of that level, in their units; 0 without an expected level."""
        return _joined([view.sky_precision for view in self.views], len(self.unit))

    @property
    def shifts(self) -> np.ndarray:
        """Present shifts (n_observations, 2) [model px] of the observations' pixels."""
        return np.array([view.op.shift for view in self.views])

    def shift(self, shifts):
        """Moves the observations' pixels to these shifts."""
        for view, shift in zip(self.views, shifts, strict=True):
            view.op.shift = shift

    def end(self, scene, state, findings, status):
        """Ends the fit with this state."""
        self.scene, self.state, self.strength_estimates, self.status = (
            scene,
            state,
            findings,
            status,
        )

    def interrupt(self):
        """Records that the user interrupted the fit."""
        self.status = Ended.INTERRUPTED

    def note_seconds(self, stage, seconds):
        """Records the time of a stage."""
        self.seconds[stage] = seconds

    def result(self, seen: RenderedModel) -> Result:
        """Everything back in the data's own units; seen: by `render_fits`."""
        began, scene, peaks = time.perf_counter(), self.scene, _peaks(self.state)
        morphs = _scaled(self.state)
        components = [
            Component(
                int(self.fitted[self.start.source[i]]),
                (int(scene.origin[i][0]), int(scene.origin[i][1])),
                morphs[i],
                seen.spectra[i] * self.unit,
            )
            for i in range(len(morphs))
        ]
        rendered = _rendered(self, seen)
        self.seconds["result"] += time.perf_counter() - began
        result = Result(
            observations=self.blend.observations,
            frame=self.frame,
            sources=self.sources,
            components=tuple(components),
            rendered=rendered,
            sky=(seen.sky + self.sky_level) * self.unit,
            covariance=seen.covariance * self.unit[:, None, None] ** 2,
            shifts=self.shifts,
            losses=np.array(self.losses),
            status=self.status,
            thetas=_by_source(self, self.start.thetas),
            structures=_structures(self),
            psf_error=self.settings.psf_error,
            unlisted=self.unlisted,
            messages=tuple(self.messages),
            seconds=self.seconds,
        )
        return with_errors(self, result, peaks, seen)


def start_fits(fits):
    """Starts fits of one signature side by side."""
    began = time.perf_counter()
    for fit in fits:
        fit.forget_start()
    settings, patches = fits[0].settings, [fit.patch for fit in fits]
    given = {"fit_sky": settings.fit_sky, "tol": settings.start_tol}
    points = fit_start_profiles(patches, **given, second=settings.adds_components)
    seconds = (time.perf_counter() - began) / len(fits)
    for fit, point in zip(fits, points, strict=True):
        fit.begin(point, seconds)
    carry_structure([fit for fit in fits if fit.blend.structures])


def render_fits(fits) -> list[RenderedModel]:
    """Renders ended fits of one signature side by side, as `Fit.result` needs them."""
    began = time.perf_counter()
    found = render_models([_model(fit) for fit in fits], fit_sky=fits[0].settings.fit_sky)
    for fit in fits:
        fit.note_seconds("result", (time.perf_counter() - began) / len(fits))
    return found


def _joined(parts, n_channels):
    """Arrays (Co,) of all observations as one (C,); 0 where there are none, but None."""
    return np.zeros(n_channels) if parts[0] is None else np.concatenate(parts)


def _model(fit) -> MorphologyModel:
    """A fit's present morphologies, max = 1, and the views that render them."""
    pairs = zip(fit.views, fit.blend.observations, strict=True)
    return MorphologyModel(
        fit.padded.shape,
        fit.views,
        [unfiltered_view(fit.geometry, o, v) if o.noise is not None else None for v, o in pairs],
        fit.start.source,
        fit.scene.origin,
        _scaled(fit.state),
        min_light=[shape.min_light for shape in fit.start.shapes],
    )


def _peaks(state):
    """Largest values (n,) of the solver's morphologies; 1 of those that are 0."""
    return np.array([m.max() if m.max() > 0 else 1.0 for m in state.morph])


def _scaled(state):
    """The morphologies (n) with max = 1, float64."""
    return [m.astype(np.float64) / p for m, p in zip(state.morph, _peaks(state), strict=True)]


def data_bytes(fit) -> int:
    """Device memory [bytes] that a fit's images take in a batch, roughly, whatever its sources."""
    return 8 * image_numbers([view.op for view in fit.views])


def scene_bytes(fit) -> int:
    """Device memory [bytes] that a fit takes in a batch, roughly, once it has begun."""
    return fit.scene.n_bytes + fit.settings.solver_bytes(fit.scene)


def _inside(frame, positions, sources=()):
    """Positions (n,) inside the frame, and messages about the others; ValueError if none is."""
    inside, n = frame.contains(positions), len(positions)
    if not inside.any():
        raise ValueError(
            f"none of the {n} sources lies inside the model frame {frame.shape}"
            + _order_hint(frame, sources)
        )
    return inside, [
        f"a source lies outside the model frame: source {i} at (y, x) = ({p[0]:.1f}, {p[1]:.1f}) "
        f"[px] of {frame.shape}; if its light is in the images, pass a larger frame"
        for i, p in enumerate(positions)
        if not inside[i]
    ]


def _order_hint(frame, sources):
    """The order of sky_deg, if any of the sources (n,) has two numbers that seem to be swapped."""
    own = [s for s in sources if s.sky_deg is not None and s.sky_frame is None]
    swapped = [replace(s, sky_deg=s.sky_deg[::-1]) for s in own]
    there = frame.contains(frame.positions_of(swapped))
    wrong = [s for s, one in zip(own, there, strict=True) if one or abs(s.sky_deg[1]) > 90]
    if frame.grid.is_flat or not wrong:
        return ""
    return (
        f": sky_deg is {wrong[0].sky_deg}, must be (right ascension, declination) or the WCS's own "
        "longitude and latitude: swap the two"
    )


def _by_source(fit, values):
    """Values (n) of a fit's components as a tuple for each source."""
    found: list[tuple] = [()] * len(fit.sources)
    for i, value in zip(fit.fitted[fit.start.source], values, strict=True):
        found[i] += (value,)
    return tuple(found)


def _structures(fit):
    """See Result.structures."""
    if (learned := fit.state.learned) is None:
        return ()
    rows = zip(
        fit.scene.origin.tolist(), learned.structure, learned.strengths, learned.clear, strict=True
    )
    return _by_source(
        fit,
        [
            None
            if fixed
            else ComponentStructure(
                tuple(origin), tuple(z.astype(np.float32) for z in scales), alpha, bool(clear)
            )
            for fixed, (origin, scales, alpha, clear) in zip(fit.scene.fixed, rows, strict=True)
        ],
    )


def _rendered(fit, seen):
    """See Result.rendered: of an observation as it was taken, 0 where the frame does not cover."""
    rendered = []
    for view, o, here, bare in zip(
        fit.views, fit.blend.observations, seen.observed, seen.unfiltered_views, strict=True
    ):
        found = here if bare is None else bare
        shape = len(found), *o.data.shape
        images = [image * view.covered[found.window(i)] for i, image in enumerate(found.images)]
        rendered.append(ComponentImages.cropped(shape, found.low, images))
    return tuple(rendered)


def _padded_frame(frame, pad):
    """The frame with its sides grown to multiples of `pad`, from the same first pixel on."""
    shape = tuple(round_up(n, pad) for n in frame.shape)
    return frame if shape == frame.shape else Frame(frame.grid.cutout(0, 0, shape), frame.psf)


def _dark_message(i_source, position):
    """Message about a source far from any light."""
    y, x = position
    return (
        f"a source lies far from any light: source {i_source} at (y, x) = ({y:.1f}, {x:.1f}) [px] "
        f"in the model frame; no image shows {LIGHT_SIGMAS:g} sigma there or beside it"
    )
