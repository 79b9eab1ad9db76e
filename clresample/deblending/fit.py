"""One blend on its way from data to result: views of its observations, start, scene, result."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ..resampling.transfer import noise_warnings
from ..sky.extent import box_slices
from ..sky.frame import Frame
from ..sky.sources import Point
from .blend import INTERRUPTED
from .posterior.posterior import errors_of
from .resize import box_around
from .result import Component, Result
from .shifts import shift_steps
from .solver.curvature import damping
from .solver.scene import Scene, State
from .spectra import solve_spectra
from .start import LIGHT_SIGMAS, start
from .view import allow_for_psf_error, as_taken, whitened_view

# A spectrum's step size counts in errors of the flux plus this part of the flux: bright sources,
# whose errors are far smaller than what a changing morphology does to their flux, can follow it.
SPECTRUM_PART = 0.02
# Least power sum |u|^2 of a component's whitened image u in a channel, whose root is the inverse of
# its spectrum's error; and the error from which on the channel holds nothing of the component, so
# that its spectrum is not stepped there. A covered component has errors of 1e6 at most.
LEAST_POWER, UNSEEN = 1e-30, 1e14
# The stopping rule compares the best loss with the best one this many iterations ago: losses of
# single iterations scatter, and a smaller number would take a pause for the end.
PATIENCE = 15
# A loss this many times the best one, or NaN, is a divergence.
DIVERGED = 10.0


@dataclass(frozen=True, eq=False)
class _Best:
    """The lowest loss so far, and what it belongs to."""

    loss: float
    scene: Scene | None
    state: State | None
    shifts: np.ndarray


class Fit:
    """One blend on its way from data to result.

    blend, settings, frame: what is fitted, how, and on which Frame
    sources: the blend's, with positions in the frame's pixels where an observation's were given
    fitted (n,): indices of those inside the frame; dark (n_dark,): of those far from any light
    views: the observations as WhitenedViews, whose operators hold the observations' shifts
    start, profiles (n, Ny, Nx): the StartingPoint, and its profiles over the frame with max = 1
    noise (C,): of one model pixel, in the views' units; unit (C,) [counts]: of these
    scene, state: Scene and State, as of the start or of where `settle` left them; findings: what a
        LearnedPrior has learned by then, or None; losses, status, messages, seconds: see Result
    """

    def __init__(self, blend, settings, device, dtype, *, pad):
        began = time.perf_counter()
        self.blend, self.settings = blend, settings
        self.frame = blend.made_frame()
        shifts = blend.known_shifts()
        positions = self.frame.place(blend.sources, blend.observations, shifts)
        pairs = zip(blend.sources, positions, strict=True)
        self.sources = tuple(source.on_frame(position) for source, position in pairs)
        inside, self.messages = _inside(self.frame, positions)
        self.fitted = np.flatnonzero(inside)
        padded, private = _padded_frame(self.frame, pad), settings.fit_shifts or shifts.any()
        self.views = [
            whitened_view(self.frame, padded, o, pad, device, dtype, private=private)
            for o in blend.observations
        ]
        if private:
            self._shift(shifts)
        for o, view in zip(blend.observations, self.views, strict=True):
            self.messages += [f"{o.label}: {line}" for line in noise_warnings(view.op.certificate)]
        if not any(view.root.any() for view in self.views):
            raise ValueError("no observed pixel on the model frame has a weight")
        self.unit = np.concatenate([view.unit for view in self.views])
        sources = [self.sources[i] for i in self.fitted]
        self.start = start(
            self.frame, sources, positions[inside], self.views, fit_sky=settings.fit_sky
        )
        self.dark = self.fitted[self.start.dark]
        self.messages += [_dark_message(i, positions[i]) for i in self.dark]
        self.profiles = _peak_of_one(self.start.profiles)
        self.views = allow_for_psf_error(self.views, self.start.stars(), settings.psf_error)
        self.noise = np.concatenate([view.pixel_noise for view in self.views])
        self.scene, self.state = _start_scene(self, padded.shape)
        self.losses, self.status, self.findings = [], "iteration limit", None
        self._best = _Best(np.inf, None, None, self.shifts)
        self.seconds = {"setup": time.perf_counter() - began}

    @property
    def shifts(self) -> np.ndarray:
        """Present shifts (n_observations, 2) [model px] of the observations' pixels."""
        return np.array([view.op.shift for view in self.views])

    def _shift(self, shifts):
        """Move the observations' pixels to these shifts."""
        for view, shift in zip(self.views, shifts, strict=True):
            view.op.shift = shift

    def move(self, scene, state):
        """Shift the observations to where the model, as it is by now, fits each of them best."""
        self._shift(self.shifts + shift_steps(scene, state))

    def stopped(self, losses) -> bool:
        """Take the losses (n,) of the last iterations; whether the fit ends here, and why."""
        self.losses.extend(losses.tolist())
        reason = stop_reason(self.losses, len(losses), self.settings.tol)
        self.status = reason or self.status
        return reason is not None

    def end(self, scene, state, findings, status):
        """End here, with this state."""
        self.scene, self.state, self.findings, self.status = scene, state, findings, status

    def interrupt(self):
        """Note that the fit ends because the user wants it to."""
        self.status = INTERRUPTED

    def note_seconds(self, stage, seconds):
        """Take down how long a stage has taken."""
        self.seconds[stage] = seconds

    def remember(self, loss, scene, state):
        """Keep a state, at the present shifts, if its loss is the lowest so far."""
        if loss < self._best.loss:
            self._best = _Best(float(loss), scene, state, self.shifts)

    def settle(self, loss, scene, state):
        """End here, with the present state, or with the best one where that is better; the present
        one, if it was interrupted, may be half-way through an iteration."""
        best = self._best
        if self.status != INTERRUPTED and loss <= best.loss:
            self.scene, self.state = scene, state
        elif best.state is not None:
            loss, self.scene, self.state = best.loss, best.scene, best.state
            if not np.array_equal(best.shifts, self.shifts):
                self._shift(best.shifts)
        else:
            return
        self.losses.append(float(loss))

    def result(self) -> Result:
        """Everything back in the data's own units, spectra solved for the final morphologies."""
        began, scene, n = time.perf_counter(), self.scene, len(self.state.spectra)
        morphs = np.zeros((n, *scene.shape))
        peaks = np.array([m.max() if m.max() > 0 else 1.0 for m in self.state.morph])
        boxes = [box_slices(*pair) for pair in zip(scene.origin, map(np.shape, scene.profile))]
        for full, box, m, peak in zip(morphs, boxes, self.state.morph, peaks, strict=True):
            full[box] = m / peak
        observed = [v.observe(morphs) for v in self.views]
        units = [v.whiten(images) for v, images in zip(self.views, observed, strict=True)]
        solved = solve_spectra(units, self.views, self.settings.fit_sky)
        spectra, sky, covariance = solved
        components = [
            Component(
                int(self.fitted[self.start.source[i]]),
                (int(scene.origin[i][0]), int(scene.origin[i][1])),
                morphs[i][box],
                spectra[i] * self.unit,
            )
            for i, box in enumerate(boxes)
        ]
        rendered = _rendered(self, observed, morphs)
        self.seconds["result"] = time.perf_counter() - began
        errors, draws = errors_of(self, components, peaks, units, solved)
        return Result(
            observations=self.blend.observations,
            frame=self.frame,
            sources=self.sources,
            components=tuple(components),
            rendered=rendered,
            sky=sky * self.unit,
            covariance=covariance * self.unit[:, None, None] ** 2,
            errors=errors,
            draws=draws,
            shifts=self.shifts,
            losses=np.array(self.losses),
            status=self.status,
            messages=tuple(self.messages),
            seconds=self.seconds,
        )


def _inside(frame, positions):
    """Which positions (n,) lie inside the frame, and messages of the others; ValueError if none."""
    inside, n = frame.inside(positions), len(positions)
    if not inside.any():
        raise ValueError(f"none of the {n} sources lies inside the model frame {frame.shape}")
    return inside, [
        f"source {i} at {p} [px] lies outside the model frame {frame.shape}"
        for i, p in enumerate(positions)
        if not inside[i]
    ]


def _rendered(fit, observed, morphs):
    """See Result.rendered; observed: of morphs (n, Ny, Nx), as the views see them."""
    rendered = []
    for view, o, images in zip(fit.views, fit.blend.observations, observed, strict=True):
        if o.noise is not None:
            images = as_taken(o, view, fit.frame, morphs)
        images = images[..., : o.data.shape[1], : o.data.shape[2]]
        rendered.append(images.astype(np.float64) * view.covered[: o.shape[1], : o.shape[2]])
    return tuple(rendered)


def _padded_frame(frame, pad):
    """The frame with its sides grown to multiples of `pad`, from the same first pixel on."""
    shape = tuple(-(-n // pad) * pad for n in frame.shape)
    return frame if shape == frame.shape else Frame(frame.grid.cutout(0, 0, shape), frame.psf)


def _peak_of_one(profiles):
    """Profiles (n, Ny, Nx) with max = 1; dark ones as they are."""
    peak = profiles.max(axis=(1, 2), keepdims=True)
    return profiles / np.where(peak > 0, peak, 1)


def _start_scene(fit, shape) -> tuple[Scene, State]:
    """The scene of a fit on a padded frame of this shape, and its state at the start."""
    begin, views, profiles = fit.start, fit.views, fit.profiles
    units = [v.render(profiles) for v in views]
    spectra, sky, _ = solve_spectra(units, views, fit.settings.fit_sky)
    power = np.concatenate([(u**2).sum(axis=2) for u in units], axis=1)
    error = 1 / np.sqrt(np.maximum(power, LEAST_POWER))
    boxes = [
        box_around(image, begin.positions[i_source], (spectrum / fit.noise).max())
        for image, i_source, spectrum in zip(profiles, begin.source, spectra, strict=True)
    ]
    morphs = [
        image[box_slices(low, size)].copy()
        for image, (low, size, _) in zip(profiles, boxes, strict=True)
    ]
    scene = Scene(
        shape=shape,
        extent=fit.frame.shape,
        ops=[v.op for v in views],
        data=[v.data for v in views],
        weights=[v.root**2 for v in views],
        origin=np.array([low for low, _, _ in boxes]),
        center=np.array([center for _, _, center in boxes]),
        profile=morphs,
        fixed=np.array([isinstance(fit.sources[fit.fitted[i]], Point) for i in begin.source]),
        scale=np.where(error < UNSEEN, error + SPECTRUM_PART * spectra, 0),
        power=power,
        fit_sky=fit.settings.fit_sky,
    )
    latent = [np.zeros_like(m) for m in morphs]
    state = State(latent, [m.copy() for m in morphs], spectra, sky)
    if not fit.settings.learns:
        scene = replace(scene, damping=damping(scene, state, fit.settings.prior))
    return scene, state


def _dark_message(i_source, position):
    """What to say of a source far from any light."""
    y, x = position
    return (
        f"source {i_source} at (y, x) = ({y:.1f}, {x:.1f}) [px] in the model frame lies far from "
        f"any light: no image shows {LIGHT_SIGMAS:g} sigma there or beside it"
    )


def stop_reason(losses, n_new, tol) -> str | None:
    """The stopping rule: "diverged", "converged", or None to go on.

    losses: of all iterations so far, of which the last n_new are new; tol: see Settings
    """
    best = np.nanmin(losses) if np.isfinite(losses[-n_new:]).all() else np.nan
    if np.isnan(best) or losses[-1] > DIVERGED * best:
        return "diverged"
    if len(losses) > PATIENCE and min(losses[:-PATIENCE]) - best < tol * best:
        return "converged"
    return None
