"""Joint deblending: one scene fitted to all instruments' images, one blend or thousands."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from .device import DeviceError, get_device
from .engine import Engine
from .fit import Fit
from .frame import Frame
from .observation import Observation
from .problem import Prior, Rates
from .prox import Chain, MaxNorm, Monotone, Positivity, SumNorm
from .resize import resized
from .result import Result
from .shifts import shift_steps
from .sources import Source

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

    max_iter: most iterations; tol: a fit ends when its best loss falls by less than this part of
        itself over 15 iterations
    prior: the Prior of extended sources' morphologies about their smooth profiles; None fits the
        morphologies themselves, by the constraints alone
    constraints: Chain of proximal operators on the morphologies: non-negative, and monotone by the
        sweep
    rates: the solver's steps
    fit_shifts: let each observation but the first move by a constant shift
    fit_sky: fit a constant per channel
    """

    max_iter: int = 300
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
        scaling = [p for p in self.constraints._steps() if isinstance(p, MaxNorm | SumNorm)]
        if self.prior is not None and scaling:
            raise ValueError(
                f"constraints hold {scaling[0]!r}, but with a prior the profiles set the "
                "scale of the morphologies: leave it out, or give prior=None"
            )


def deblend(
    observations,
    sources,
    *,
    frame=None,
    shifts=None,
    settings=None,
    device=None,
    dtype=np.float32,
    progress=None,
) -> Result:
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
    fit = Fit(blend, settings, device, dtype, pad=1)
    (done,) = _iterate([fit], settings, device, dtype, progress)
    return done.result()


def deblend_many(
    blends, *, settings=None, device=None, dtype=np.float32, memory=MEMORY, progress=None
) -> list[Result | Failure]:
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
                fit = Fit(blend, settings, device, dtype, pad=pad)
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
    return [
        Failure(blend, INTERRUPTED) if done is None else done
        for blend, done in zip(blends, out, strict=True)
    ]


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
                _remember(running, live, engine)
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
                    _remember(running, live, engine)
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
            f.shifts = f.shifts + shift_steps(p)
            for op, shift in zip(p.ops, f.shifts, strict=True):
                op.shift = shift
    for i, op in enumerate(engine.ops):
        op.shift = np.array([f.shifts[i] for f in fits])


def _engine(fits, settings, device, dtype):
    return Engine(
        [f.problem for f in fits],
        device,
        dtype,
        chain=settings.constraints,
        prior=settings.prior,
        rates=settings.rates,
    )


def _stopped(fits, live, losses, settings):
    """Which fits end here (B,), from the losses (n, B) of the last iterations."""
    stop = np.zeros(len(fits), bool)
    for i, f in enumerate(fits):
        if not live[i]:
            continue
        f.losses.extend(losses[:, i].tolist())
        finite = np.isfinite(losses[:, i]).all()
        best = np.nanmin(f.losses) if finite else np.nan
        if not finite or f.losses[-1] > DIVERGED * best:
            f.status, stop[i] = "diverged", True
        elif len(f.losses) > PATIENCE and min(f.losses[:-PATIENCE]) - best < settings.tol * best:
            f.status, stop[i] = "converged", True
    return stop


def _remember(fits, live, engine):
    """Bring the states kept on the device back to the host where they are the best so far."""
    losses, kept = engine.best_losses(), engine.problems_now(kept=True)
    for i in np.flatnonzero(live):
        if losses[i] < fits[i].best[0]:
            fits[i].best = float(losses[i]), kept[i], fits[i].shifts


def _settle(fits, stop, engine):
    """Bring the state of the fits that stop here back to the host, with its loss: the present one,
    or the best one where that is better, or the present one half-way through an iteration."""
    _remember(fits, stop, engine)
    now, losses = engine.problems_now(), engine.final_losses()
    for i in np.flatnonzero(stop):
        f, loss = fits[i], float(losses[i])
        if f.status != INTERRUPTED and loss <= f.best[0]:
            f.problem = now[i]
        elif f.best[1] is not None:
            loss, f.problem, shifts = f.best
            if shifts is not f.shifts:
                f.shifts = shifts
                for op, shift in zip(f.problem.ops, shifts, strict=True):
                    op.shift = shift
        else:
            continue
        f.losses.append(loss)
