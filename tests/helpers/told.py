"""Fits, and an engine of theirs, that only do what they are told, and note it."""

from types import SimpleNamespace

import numpy as np

from clresample.deblending import iterate as room
from clresample.deblending.ended import Ended

CPU = SimpleNamespace(kind="CPU", compute_units=1)


class Told(SimpleNamespace):
    """A fit that notes what is done with it."""

    def __init__(self, name, status="iteration limit"):
        super().__init__(name=name, status=status, ended=None, best=None, seconds={})
        self.shifts, self.last_steps = np.zeros((2, 2)), np.full((2, 2), 9.0)
        self.losses, self.fit = [], self

    def shift(self, shifts):
        self.shifts = shifts

    def end(self, *given):
        self.ended = given

    store_final = end

    def keep_best(self, *given):
        self.best = given

    def interrupt(self):
        self.status = "interrupted"

    def note_seconds(self, stage, seconds):
        self.seconds[stage] = seconds


def learning(n_rounds, *, live=None, converged=None, failed=None, **settings):
    """Fits a, b, c under the prior that learns."""
    n = len(n_rounds)
    no = np.zeros(n, bool)
    progress = SimpleNamespace(
        live=~no if live is None else np.array(live),
        converged=no.copy() if converged is None else np.array(converged),
        failed=no.copy() if failed is None else np.array(failed),
        **{name: no.copy() for name in ("settled", "tested")},
        n_rounds=np.array(n_rounds),
        loss=np.arange(1.0, n + 1),
        chi2=lambda: np.array([1.0, 2.0, 4.0])[:n],
    )
    engine = SimpleNamespace(
        progress=progress,
        scenes=[f"scene {i}" for i in range(n)],
        states=lambda _: [f"state {i}" for i in range(n)],
        findings=lambda which: [f"findings {i}" if on else None for i, on in enumerate(which)],
        followed=[],
    )
    engine.update_shifts = lambda moved: engine.followed.append(moved.tolist())
    engine.slopes = lambda which: [f"slopes {i}" for i in range(n)]
    settings = SimpleNamespace(
        **({"max_iter": 100, "fit_shifts": False, "loss_tol": 0.5} | settings)
    )
    past = engine, [None] * n, np.tile([0, np.inf, 0, 0], (n, 1))
    return room.LbfgsRun([Told(c) for c in "abc"[:n]], settings, CPU, None, past)


def named(name, status="converged", shifts=0.0, of=None):
    """A fit that is no more than its name; of: the one whose pixels it shares."""
    one = SimpleNamespace(name=name, status=status, messages=[], seconds={"fit": 1.0})
    one.at = of.at if of else {"shifts": shifts}
    one.shifts, one.losses = shifts, [1.0]
    one.note_seconds = one.seconds.__setitem__
    one.shift = lambda shifts: one.at.update(shifts=shifts)
    one.interrupt = lambda: setattr(one, "status", Ended.INTERRUPTED)
    return one
