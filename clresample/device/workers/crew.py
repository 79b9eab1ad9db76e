"""The loop that gives tasks to workers and survives their faults."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar

from ..discovery import DeviceError
from .outcome import Cause, Outcome, Reason

# [s] Interval between two checks of the workers' times.
POLL_S = 1.0


class TaskQueue:
    """Tasks that wait for a worker, in the order in which they begin."""

    def __init__(self, tasks):
        self.waiting = deque(tasks)

    def __len__(self):
        return len(self.waiting)

    def take(self, worker, workers):
        """Removes the next task, for one of all workers."""
        return self.waiting.popleft()

    def put_back(self, tasks):
        """Puts tasks before all others, in their order."""
        self.waiting.extendleft(reversed(list(tasks)))


@dataclass(eq=False)
class Worker:
    """One worker and its task.

    number: from 0; task: None if it is idle; start_s [s]: when its task began, monotonic clock
    n_faults: number of consecutive faults of its device
    """

    number: int
    task: Any = None
    start_s: float = 0.0
    n_faults: int = 0

    def outcome(self, value=None, reason=None) -> Outcome:
        """Outcome of its task, now."""
        return Outcome(self.task, value, reason, self.number, self.start_s, time.monotonic())

    def overtime(self, limit_s) -> Outcome | None:
        """Outcome of a task over the time limit [s]; None within it, or without one."""
        if self.task is None or limit_s is None or time.monotonic() - self.start_s <= limit_s:
            return None
        why = f"its worker took over {limit_s:g} s and was ended"
        return self.outcome(reason=Reason(why, Cause.WORKER))


class Crew:
    """Workers with one task each at most; a kind of workers has these methods.

    workers: list of all that may get tasks
    ready(n_tasks): idle workers for a number of tasks, after those that died are replaced
    send(worker, job): sends a worker its task, of a job: the constants of this run
    ended(job): pairs (worker, Outcome) of tasks that have ended, after waiting for some
    renew(worker): opens its device anew after a fault; drop(worker, reason): removes it

    FAULTS: causes that are the device's, so that its task is repeated elsewhere
    MAX_FAULTS: number of consecutive faults of a worker after which it gets no more tasks. One
        error may come from a driver that was reset; after the second the device counts as lost
    """

    FAULTS: ClassVar[tuple[Cause, ...]] = (Cause.DEVICE,)
    MAX_FAULTS: ClassVar[int] = 2

    @property
    def busy(self):
        """Workers that have a task."""
        return [worker for worker in self.workers if worker.task is not None]

    def outcomes(self, job, queue, again=None):
        """Yields the Outcome of every task, as they end.

        queue: TaskQueue, or another class with its methods
        again: called with the Outcome of a task that failed; returns the tasks to run in its place,
            or None to accept the Outcome. A failed task is yielded only if it is accepted

        After a fault the worker's device is opened anew and the task is repeated, which is not
        counted as a failure. After MAX_FAULTS faults in a row the worker is dropped, and the others
        continue. Raises DeviceError when no worker is left.
        """
        while queue or self.busy:
            for worker in self.ready(len(queue)):
                if queue:
                    worker.task = queue.take(worker, self.workers)
                    worker.start_s = time.monotonic()
                    self.send(worker, job)
            for worker, outcome in self.ended(job):
                worker.task = None
                if outcome.cause in self.FAULTS:
                    queue.put_back([outcome.task])
                    self._count_fault(worker, outcome.reason)
                    continue
                if outcome.cause is not Cause.WORKER:
                    worker.n_faults = 0
                more = None if again is None or outcome.reason is None else again(outcome)
                if more is None:
                    yield outcome
                else:
                    queue.put_back(more)

    def _count_fault(self, worker, reason):
        self.renew(worker)
        worker.n_faults += 1
        if worker.n_faults >= self.MAX_FAULTS:
            self.drop(worker, reason)
            if not self.workers:
                raise DeviceError(reason.message)
