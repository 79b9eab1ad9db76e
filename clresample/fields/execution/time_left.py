"""Time until the end of a stage, predicted from the tasks that have ended."""

from __future__ import annotations

import heapq
import json
import math
from contextlib import suppress

from ...device.device_cache import cache_folder
from ...files.atomic import FileError, atomic_file

FILE = "field_pace.json"
# Weight of the pace of an earlier run, as a fraction of the cost of all tasks of a stage.
REMEMBERED = 0.3
# Remaining time of a task that has taken longer than predicted, per time that it is overdue.
OVERDUE = 0.5


class TimeLeft:
    """Predicts the end of tasks that several workers run in a given order.

    Tasks that have ended give the time per cost; the others are dealt to the workers as they become
    free, so that the last long tasks, which leave workers idle, count in full.

    costs {task: cost}: relative times, in the order in which the tasks begin
    n_workers: that run side by side; more are assumed once more have ended a task
    began [s]: by the clock of the times of all methods
    pace [s per cost]: of an earlier run, or None
    """

    def __init__(self, costs, n_workers, began, pace=None):
        self.waiting, self.n_workers, self.began = dict(costs), max(1, n_workers), began
        self._known = REMEMBERED * sum(costs.values()) if pace else 0.0
        self._known_seconds = self._known * (pace or 0.0)
        self._cost = self._seconds = 0.0
        self._free: dict[int, float] = {}  # {worker: when its last task ended}

    def end(self, task, worker, start_s, end_s):
        """Counts a task that has ended; unknown ones give no time per cost."""
        cost = self.waiting.pop(task, None)
        if cost is not None:
            self._cost += cost
            self._seconds += end_s - start_s
        self._free[worker] = end_s

    def split(self, task, costs):
        """Replaces a task by others; costs {task: cost}: theirs, which begin before all waiting."""
        self.waiting.pop(task, None)
        self.waiting = costs | self.waiting

    @property
    def pace(self) -> float | None:
        """Time per cost [s] of the tasks that have ended, None without one."""
        return self._seconds / self._cost if self._cost else None

    def left(self, now) -> float | None:
        """Predicted time [s] from now to the end of the last task, None without any pace."""
        if not self._cost + self._known:
            return None
        n_idle = max(0, self.n_workers - len(self._free))
        # the first of the tasks left are running, each since a worker became free
        free = sorted([*self._free.values(), *[self.began] * n_idle])
        costs = list(self.waiting.values())
        running = list(zip(free, costs, strict=False))
        seconds, cost = self._seconds + self._known_seconds, self._cost + self._known
        busy = [_end_of(start, seconds / cost * c, now) for start, c in running]
        last = max([now, *busy])
        # tasks that are overdue count too: the first to end are those that take less than predicted
        seconds += sum(end - start for end, start in zip(busy, free, strict=False))
        pace = seconds / (cost + sum(c for _, c in running))
        heapq.heapify(busy)
        for c in costs[len(running) :]:
            heapq.heapreplace(busy, end := busy[0] + pace * c)
            last = max(last, end)
        return last - now


def _end_of(start, seconds, now):
    """Predicted end of a task that is running and should take some seconds."""
    end = start + seconds
    return max(end, now + OVERDUE * (now - end))


def remembered_pace(run) -> float | None:
    """Pace [s per cost] of the last run alike, of any field, or None. run: text, what is alike."""
    pace = _paces().get(run)
    return pace if isinstance(pace, float) and 0 < pace < math.inf else None


def remember_pace(run, pace):
    """Stores a pace in the cache folder; where that cannot be written, nothing is stored."""
    with suppress(OSError, FileError):
        path = cache_folder() / FILE
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as part:
            part.write_text(json.dumps(_paces() | {run: pace}, indent=1))


def _paces():
    with suppress(OSError, ValueError):
        found = json.loads((cache_folder() / FILE).read_text())
        if isinstance(found, dict):
            return found
    return {}
