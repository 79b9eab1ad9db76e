"""The loop of a batch of fits: steps, stopping rule, boxes that follow their light."""

from __future__ import annotations

import time

import numpy as np

from .blend import INTERRUPTED
from .resize import resized
from .shifts import shift_steps
from .solver.engine import Engine

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


def iterate(fits, settings, device, dtype, progress=None):
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
