"""Joint deblending: one scene fitted to all instruments' images, one blend or thousands."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

from .device import DeviceError, get_device
from .engine import Engine, Prior, Problem, Rates
from .frame import Frame, model_frame
from .initialize import View, box_around, solve_spectra, start
from .observation import Observation, check_observations
from .operators import operator
from .prox import Chain, Monotone, Positivity
from .resize import resized
from .result import Component, Result
from .shifts import shift_steps
from .sources import Point, Source

# Status of a fit that Ctrl-C ended.
INTERRUPTED = "interrupted"
# So often (iterations) losses come back from the device.
CHECK = 5
# So often (iterations) observations are shifted: what follows a shift is most of it by then.
MOVE = 10
# The stopping rule compares the best loss with the best one this many iterations ago.
PATIENCE = 15
# A loss this many times the best one, or NaN, is a divergence.
DIVERGED = 10.0
# A batch is repacked when this part of it has converged.
REPACK = 0.25
# So often (iterations) boxes are fitted to the light they hold.
RESIZE = 40
# Ragged batches: frames and observations are padded to multiples of this [px].
PAD_PX = 16
# Spectrum steps come in units of the flux's error plus this part of the flux.
SPECTRUM_PART = 0.02
# Device memory of one group of scenes [bytes], unless told otherwise.
MEMORY = 1 << 30
# What can go wrong with one blend and is no reason to give up the others.
ERRORS = (ValueError, ArithmeticError, DeviceError, MemoryError, np.linalg.LinAlgError)
# Scenes fitted side by side: enough to hide the launches, few enough for a CPU's cache.
SCENES = {"CPU": 32}
SCENES_ELSEWHERE = 1024


@dataclass(frozen=True)
class Blend:
    """One patch of sky: what was seen, and what is there.

    observations: at least one Observation; sources: Point and Extended
    frame: the model's Frame; None = `model_frame` of the observations
    shifts (n_observations, 2) [model px]: of the observations' pixels, where known; a fit of shifts
        starts from them. What moved by more than a pixel is best fitted again from there
    """

    observations: tuple[Observation, ...]
    sources: tuple[Source, ...]
    frame: Frame | None = None
    shifts: np.ndarray | None = None


@dataclass(frozen=True)
class Failure:
    """A blend of a batch that could not be fitted; `status` says why."""

    blend: Blend
    status: str

    converged = False


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a fit goes.

    max_iter: most iterations; tol: a fit ends when the loss falls by less than this part of itself
        over 5 iterations
    prior: the Prior of extended sources' morphologies about their smooth profiles; None fits the
        morphologies themselves, by the constraints alone
    constraints: Chain of proximal operators on the morphologies: non-negative, and monotone by the
        sweep
    rates: the solver's steps
    fit_shifts: let each observation but the first move by a constant shift
    fit_sky: fit a constant per channel
    """

    max_iter: int = 200
    tol: float = 1e-5
    prior: Prior | None = Prior()
    constraints: Chain = field(default_factory=lambda: Chain(Positivity(), Monotone()))
    rates: Rates = Rates()
    fit_shifts: bool = False
    fit_sky: bool = False

    def __post_init__(self):
        if self.max_iter < 0:
            raise ValueError(f"max_iter is {self.max_iter}, must be 0 or more")
        if not 0 <= self.tol < 1:
            raise ValueError(f"tol is {self.tol}, must be at least 0 and under 1")


def deblend(observations, sources, *, frame=None, shifts=None, settings=None, device=None,
            dtype=np.float32, progress=None) -> Result:
    """Fit one scene to all observations at once.

        min 1/2 sum_o |sqrt(w_o) (R_o sum_s A_s S_s - d_o)|^2 + 1/2 |z|^2,  A >= 0, S constrained

    observations, sources, frame, shifts: see Blend; settings: see Settings
    progress: called every few iterations with their number so far and the loss (1,)
    raises ValueError for what `check_observations`, `model_frame` and `Source` refuse, and when no
    source lies inside the frame. Ctrl-C ends the fit with the best state so far.
    """
    blend = Blend(tuple(observations), tuple(sources), frame, shifts)
    settings = settings or Settings()
    device = get_device(device)
    fit = _Fit(blend, settings, device, dtype, pad=1)
    (done,) = _iterate([fit], settings, device, dtype, progress)
    return done.result()


def deblend_many(blends, *, settings=None, device=None, dtype=np.float32, memory=MEMORY,
                 progress=None) -> list[Result | Failure]:
    """Fit many blends side by side; each comes out as if it were fitted alone, to float accuracy.

    blends: Blend, with sizes, sources, PSFs, WCS and instruments of their own
    memory [bytes]: of the device for one group of scenes
    progress: called with the number of blends done, after each group and each failure
    returns a Result for each blend, in their order, or a Failure: it does not harm the others.
        Ctrl-C ends the fits of the group that runs with the best state so far; what was done before
        comes back, and Failures with the status "interrupted" for the rest
    """
    settings, device = settings or Settings(), get_device(device)
    blends = list(blends)
    out: list[Result | Failure | None] = [None] * len(blends)
    pad = PAD_PX if len({_sizes(b) for b in blends}) > 1 else 1
    limit = SCENES.get(device.kind, SCENES_ELSEWHERE)
    waiting = defaultdict(list)
    n_done = 0

    def count(n):
        nonlocal n_done
        n_done += n
        if progress is not None:
            progress(n_done)

    def run(group):
        for i, done in _try(group, settings, device, dtype):
            out[i] = done
        count(len(group))
        if any(fit.status == INTERRUPTED for _, fit in group):
            raise KeyboardInterrupt

    try:
        for i, blend in enumerate(blends):
            try:
                fit = _Fit(blend, settings, device, dtype, pad=pad)
            except ERRORS as error:
                out[i] = Failure(blend, f"failed: {error}")
                count(1)
                continue
            group = waiting[fit.problem.signature]
            group.append((i, fit))
            if len(group) >= limit or sum(f.bytes for _, f in group) + fit.bytes > memory:
                run(waiting.pop(fit.problem.signature))
        while waiting:
            run(waiting.popitem()[1])
    except KeyboardInterrupt:
        pass  # those without a result are told so
    return [Failure(blend, INTERRUPTED) if done is None else done
            for blend, done in zip(blends, out, strict=True)]


def _try(group, settings, device, dtype):
    """Yield (index, Result or Failure) of a group of fits; one by one where all at once fails."""
    try:
        _iterate([fit for _, fit in group], settings, device, dtype)
    except ERRORS as error:
        if len(group) == 1:
            yield group[0][0], Failure(group[0][1].blend, f"failed: {error}")
            return
        for item in group:
            yield from _try([item], settings, device, dtype)
            if item[1].status == INTERRUPTED:
                return
        return
    for i, fit in group:
        try:
            yield i, fit.result()
        except ERRORS as error:
            yield i, Failure(fit.blend, f"failed: {error}")


def _sizes(blend):
    return tuple(o.data.shape for o in blend.observations), blend.frame and blend.frame.shape


class _Fit:
    """One blend on its way from data to result."""

    def __init__(self, blend, settings, device, dtype, *, pad):
        began = time.perf_counter()
        self.blend, self.settings = blend, settings
        check_observations(blend.observations)
        self.frame = blend.frame or model_frame(blend.observations)
        _check_profiles(blend.sources, self.frame)
        positions = self.frame.place(blend.sources)
        inside = self.frame.inside(positions)
        self.messages = [f"source {i} at {p} [px] lies outside the model frame {self.frame.shape}"
                         for i, p in enumerate(positions) if not inside[i]]
        self.fitted = np.flatnonzero(inside)
        if not len(self.fitted):
            raise ValueError(f"none of the {len(positions)} sources lies inside the model frame "
                             f"{self.frame.shape}")
        shifts = _shifts(blend)
        private = settings.fit_shifts or shifts.any()
        self.padded = _padded_frame(self.frame, pad)
        self.views, self.units = [], []
        for o in blend.observations:
            view, unit = _view(self.frame, self.padded, o, pad, device, dtype, private=private)
            if private:
                view.op.shift = shifts[len(self.views)]
            self.views.append(view)
            self.units.append(unit)
        if not any(view.root.any() for view in self.views):
            raise ValueError("no observed pixel on the model frame has a weight")
        self.unit = np.concatenate(self.units)
        self.losses, self.status = [], "iteration limit"
        sources = [blend.sources[i] for i in self.fitted]
        self.start = start(self.frame, sources, positions[inside], self.views,
                           fit_sky=settings.fit_sky)
        self.problem = self._problem(sources)
        self.seconds = {"setup": time.perf_counter() - began}

    def _problem(self, sources):
        begin, views = self.start, self.views
        peak = begin.base.max(axis=(1, 2), keepdims=True)
        self.base = base = begin.base / np.where(peak > 0, peak, 1)
        self.noise = _pixel_noise(views)
        units = [v.render(base) for v in views]
        spectra, sky, _ = solve_spectra(units, views, self.settings.fit_sky)
        noise = 1 / np.sqrt(np.maximum(
            np.concatenate([(u**2).sum(axis=2) for u in units], axis=1), 1e-30))
        origin, center, morphs = [], [], []
        for i, image in enumerate(base):
            brightness = (spectra[i] / self.noise).max()
            low, size, middle = box_around(image, begin.positions[begin.source[i]], brightness)
            origin.append(low)
            center.append(middle)
            morphs.append(image[low[0] : low[0] + size[0], low[1] : low[1] + size[1]].copy())
        seen = noise < 1e14
        return Problem(
            shape=self.padded.shape, extent=self.frame.shape,
            ops=[v.op for v in views],
            data=[v.data for v in views],
            weights=[v.root**2 for v in views],
            origin=np.array(origin), center=np.array(center), base=morphs,
            field=[np.zeros_like(m) for m in morphs], morph=[m.copy() for m in morphs],
            fixed=np.array([isinstance(sources[i], Point) for i in begin.source]),
            spectra=spectra, scale=np.where(seen, noise + SPECTRUM_PART * spectra, 0),
            sky=sky, fit_sky=self.settings.fit_sky,
        )

    @functools.cached_property
    def bytes(self):
        """Device memory of the scene in a batch, roughly."""
        pixels = sum(2 * np.prod(o.shape_in) + 4 * np.prod(o.shape_out) for o in self.problem.ops)
        return int(8 * (pixels + 12 * sum(m.size for m in self.problem.morph)))

    def result(self) -> Result:
        """Everything back in the data's own units, spectra solved for the final morphologies."""
        began, p, n = time.perf_counter(), self.problem, len(self.problem.spectra)
        morphs = np.zeros((n, *p.shape))
        for full, (y, x), m in zip(morphs, p.origin, p.morph, strict=True):
            peak = m.max() if m.max() > 0 else 1.0
            full[y : y + m.shape[0], x : x + m.shape[1]] = m / peak
        units = [v.render(morphs) for v in self.views]
        spectra, sky, covariance = solve_spectra(units, self.views, self.settings.fit_sky)
        components = []
        for i, ((y, x), m) in enumerate(zip(p.origin, p.morph, strict=True)):
            part = morphs[i, y : y + m.shape[0], x : x + m.shape[1]]
            components.append(Component(int(self.fitted[self.start.source[i]]), (int(y), int(x)),
                                        part, spectra[i] * self.unit))
        rendered = []
        for view, o in zip(self.views, self.blend.observations, strict=True):
            images = view.op.render(morphs.astype(view.op.dtype)).astype(np.float64)
            images *= _covered(view.op, self.frame)
            rendered.append(images[..., : o.data.shape[1], : o.data.shape[2]])
        self.seconds["result"] = time.perf_counter() - began
        return Result(
            observations=self.blend.observations, frame=self.frame, sources=self.blend.sources,
            components=tuple(components), rendered=tuple(rendered), sky=sky * self.unit,
            covariance=covariance * self.unit[:, None, None] ** 2, shifts=self.start.shifts,
            losses=np.array(self.losses), status=self.status, messages=tuple(self.messages),
            seconds=self.seconds,
        )


def _iterate(fits, settings, device, dtype, progress=None):
    """Run the fits of one signature until each has stopped; they keep their final problems."""
    began = time.perf_counter()
    running, live, engine = list(fits), np.ones(len(fits), bool), None
    try:
        engine = _engine(running, settings, device, dtype)
        for _ in range(0, settings.max_iter, CHECK):
            losses = engine.run(min(CHECK, settings.max_iter - engine.n_steps))
            stop = _stopped(running, live, losses, settings)
            if engine.n_steps >= settings.max_iter:
                stop = live.copy()
            if stop.any():
                _settle(running, stop, engine)
                live &= ~stop
            if progress is not None:
                progress(engine.n_steps, losses[-1])
            if not live.any():
                break
            if settings.fit_shifts and engine.n_steps % MOVE == 0:
                _move(running, live, engine)
            resize = engine.n_steps % RESIZE == 0
            if resize or (~live).mean() >= REPACK:
                now = zip(running, engine.problems_now(), live, strict=True)
                going = [(f, p) for f, p, on in now if on]
                changed = len(going) < len(running)
                for f, p in going:
                    f.problem = resized(p, f.base, f.noise) if resize else p
                    changed |= f.problem is not p
                if changed:
                    engine_new = _engine([f for f, _ in going], settings, device, dtype)
                    running, live = [f for f, _ in going], np.ones(len(going), bool)
                    engine = engine_new
    except KeyboardInterrupt:
        for f, on in zip(running, live, strict=True):
            f.status = INTERRUPTED if on else f.status
        if engine is not None:
            _settle(running, live, engine)
    for f in fits:
        f.seconds["fit"] = (time.perf_counter() - began) / len(fits)
    return fits


def _move(fits, live, engine):
    """Shift the observations of the fits that go on to where their models agree."""
    for f, p, on in zip(fits, engine.problems_now(), live, strict=True):
        if on:
            f.start.shifts = f.start.shifts + shift_steps(p)
            for op, shift in zip(p.ops, f.start.shifts, strict=True):
                op.shift = shift
    for i, op in enumerate(engine.ops):
        op.shift = np.array([f.start.shifts[i] for f in fits])


def _engine(fits, settings, device, dtype):
    return Engine([f.problem for f in fits], device, dtype, chain=settings.constraints,
                  prior=settings.prior, rates=settings.rates)


def _stopped(fits, live, losses, settings):
    """Which fits end here (B,), from the losses (n, B) of the last iterations."""
    stop = np.zeros(len(fits), bool)
    for i, f in enumerate(fits):
        if not live[i]:
            continue
        f.losses.extend(losses[:, i].tolist())
        now, best = f.losses[-1], np.nanmin(f.losses)
        if not np.isfinite(losses[:, i]).all() or now > DIVERGED * best:
            f.status, stop[i] = "diverged", True
        elif len(f.losses) > PATIENCE and min(f.losses[:-PATIENCE]) - best < settings.tol * best:
            f.status, stop[i] = "converged", True
    return stop


def _settle(fits, stop, engine):
    """Bring the state of the fits that stop here back to the host, with its loss: the present one,
    or the best one kept where that is better, or the present one half-way through an iteration."""
    now, kept = engine.problems_now(), engine.problems_now(kept=True)
    losses, best = engine.final_losses(), engine.best_losses()
    for i in np.flatnonzero(stop):
        fits[i].problem, loss = now[i], losses[i]
        if fits[i].status == INTERRUPTED or not losses[i] <= best[i]:
            fits[i].problem, loss = kept[i], best[i]
        if np.isfinite(loss):
            fits[i].losses.append(float(loss))


def _check_profiles(sources, frame):
    for i, source in enumerate(sources):
        profile = getattr(source, "profile", None)
        if profile is not None and np.shape(profile) != frame.shape:
            raise ValueError(f"profile of source {i} has the shape {np.shape(profile)}, "
                             f"the model frame {frame.shape}")


def _shifts(blend):
    """Shifts (n_observations, 2) [model px] that a blend comes with."""
    expected = len(blend.observations), 2
    shifts = np.zeros(expected) if blend.shifts is None else np.asarray(blend.shifts, float)
    if shifts.shape != expected or not np.isfinite(shifts).all():
        raise ValueError(f"shifts is {shifts.tolist()}, must be {expected} finite numbers")
    return shifts


def _padded_frame(frame, pad):
    shape = tuple(-(-n // pad) * pad for n in frame.shape)
    return frame if shape == frame.shape else Frame(frame.grid.cutout(0, 0, shape), frame.psf)


def _view(frame, padded, observation, pad, device, dtype, *, private):
    """An observation in units of its channels' noise, padded, and these units (Co,).

    Pixels beyond the frame itself have no weight, though they may lie on the padded one.
    """
    shape = tuple(-(-n // pad) * pad for n in observation.data.shape[1:])
    grid = observation.grid
    if shape != observation.data.shape[1:]:
        grid = grid.cutout(0, 0, shape)
    op = operator(padded, grid, observation.psf, dtype=dtype, device=device, extent=frame.shape,
                  private=private)
    low = [(0, 0)] + [(0, n - m) for n, m in zip(shape, observation.data.shape[1:], strict=True)]
    data, weights = np.pad(observation.data, low), np.pad(observation.weights, low)
    seen = weights > 0
    unit = np.array([1 / np.sqrt(np.median(w[s])) if s.any() else 1.0
                     for w, s in zip(weights, seen, strict=True)])
    root = np.sqrt(weights) * unit[:, None, None] * _covered(op, frame)
    return View(op, root, data / unit[:, None, None]), unit


def _covered(op, frame):
    """Observed pixels (My, Mx) whose centre lies on the frame itself, not on its padding."""
    return replace(op.plans[0].mapping, shape_in=frame.shape).covered


def _pixel_noise(views):
    """Noise (C,) of one model pixel per channel, in the views' units."""
    noise = []
    for view in views:
        area = abs(np.linalg.det(view.op.plans[0].mapping.matrix))
        noise += [1 / np.sqrt(area)] * view.data.shape[0]
    return np.array(noise)
