"""Thread time of the calling thread by stages: what a faster device would leave."""

from __future__ import annotations

import functools
import importlib
import threading
import time
from collections import Counter
from contextlib import contextmanager

# Functions whose time is a stage's, less that of stages which they call: "module:name", in
# clresample. What none of them takes is "rest".
STAGES = {
    "setup": ("deblending.batch:Fit",),
    "start": ("deblending.batch:start_fits",),
    "iterate": ("deblending.batch:iterate", "deblending.refit.two_component_fit:iterate"),
    "evidence": ("deblending.solver.multiscale.strengths:PriorStrengths._prepare",),
    "learn": ("deblending.solver.multiscale.engine:MultiscaleEngine._learn",),
    "blocks": (
        "deblending.solver.multiscale.strengths:PriorStrengths.request_blocks",
        "deblending.solver.multiscale.strengths:PriorStrengths.take_blocks",
    ),
    "joint step": ("deblending.iterate:LbfgsRun._take_joint_steps",),
    "refit": ("deblending.batch:refit_two_components",),
    "render": ("deblending.batch:render_fits",),
    "errors": ("deblending.fit:with_errors",),
    "result": ("deblending.fit:Fit.result",),
}


class HostClock:
    """Seconds of the thread that made it by stage, and how often each was entered there."""

    def __init__(self, timer=time.thread_time):
        self._thread = threading.get_ident()
        self.seconds, self.calls = Counter(), Counter()
        self._timer, self._within, self._last = timer, ["rest"], timer()

    def _switch(self):
        """Adds the time since the last switch to the stage that has been running."""
        now = self._timer()
        self.seconds[self._within[-1]] += now - self._last
        self._last = now

    def mean_s(self, entered, *others):
        """Seconds of a stage, and of others that belong to it, for each time it was entered."""
        total = sum(self.seconds[name] for name in (entered, *others))
        return total / max(self.calls[entered], 1)

    @contextmanager
    def stage(self, name):
        """Counts what runs inside as this stage, unless another thread runs it."""
        if threading.get_ident() != self._thread:
            yield
            return
        self._switch()
        self._within.append(name)
        self.calls[name] += 1
        try:
            yield
        finally:
            self._switch()
            self._within.pop()


@contextmanager
def host_stages(stages=None, package="clresample"):
    """Counts the functions of `stages` as long as it lasts; gives the HostClock."""
    clock, replaced = HostClock(), []
    for stage, places in (STAGES if stages is None else stages).items():
        for place in places:
            module, _, name = place.partition(":")
            *outer, name = name.split(".")
            owner = functools.reduce(getattr, outer, importlib.import_module(f"{package}.{module}"))
            function = getattr(owner, name)
            replaced.append((owner, name, function))
            setattr(owner, name, _counted(clock, stage, function))
    try:
        with clock.stage("rest"):
            yield clock
    finally:
        for owner, name, function in reversed(replaced):
            setattr(owner, name, function)


def _counted(clock, stage, function):
    @functools.wraps(function, updated=())
    def counted(*arguments, **options):
        with clock.stage(stage):
            return function(*arguments, **options)

    return counted
