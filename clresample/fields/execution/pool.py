"""Runs tasks in worker processes that may fail, hang or be killed, without losing a task."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import wait

from ...device import kernel_profiler
from ...device.discovery import DeviceError
from ..strips import STRIPS
from .process_limits import (
    die_with_parent,
    freeze_objects,
    limit_memory,
    thread_environment,
    trim_memory,
    unfreeze_objects,
)
from .reason import Cause, Reason

# [s] Interval between two checks of the workers' times.
POLL_S = 1.0
# Number of consecutive device errors of a worker, each of which gives it a new process. One error
# may come from a driver that was reset; after the second the device counts as lost.
MAX_DEVICE_FAULTS = 2


@dataclass(frozen=True, eq=False)
class Outcome:
    """End of a task: its value, or the reason why there is none.

    worker: which worker had it, from 0; start_s, end_s [s]: by the monotonic clock
    """

    task: object
    value: object = None
    reason: Reason | None = None
    worker: int = 0
    start_s: float = 0.0
    end_s: float = 0.0

    @property
    def cause(self) -> Cause | None:
        """Kind of the reason, None of a task with a value."""
        return None if self.reason is None else self.reason.cause


@dataclass(eq=False)
class _WorkerProcess:
    """run: whose function and context it has"""

    seat: int
    process: object
    pipe: object
    run: object = None
    task: object = None
    since: float = 0.0


class WorkerPool:
    """Worker processes, begun when there is work for them, alive until `close`.

    n_workers: processes; 0 = all in this one, where errors are reported but a crash is not
    limit_s [s]: a task that takes longer is ended with its worker, which is replaced; None = none
    bound [bytes]: limit on a worker's private memory, enforced by the system; None = any

    A context manager, which closes it.
    """

    def __init__(self, n_workers, limit_s=None, bound=None):
        self.n_workers, self.limit_s = n_workers, limit_s
        self._workers: list[_WorkerProcess] = []
        self._faults = dict.fromkeys(range(n_workers), 0)
        self._start = _starter(n_workers, bound)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Ends all workers, busy ones included."""
        while self._workers:
            _end(self._workers.pop())

    def begin(self, function):
        """Starts every worker now and loads in it the modules of the function."""
        for worker in self._added(self.n_workers):
            with contextlib.suppress(OSError):  # it has died: its successor loads the modules
                worker.pipe.send((function, None))

    def run(self, function, contexts, tasks, again=None):
        """Yields the Outcome of every task, as they end.

        function: called as function(context, task), in a module, so that a process can import it
        contexts: worker k gets the context numbered k modulo their number, pickled
        tasks: in the order in which they begin
        again: called with the Outcome of a task that failed; returns the tasks to run in its place,
            or None to accept the Outcome. A failed task is yielded only if it is accepted

        After a DeviceError the worker gets a new process and the task is repeated, which is not
        counted as a failure. After the next DeviceError in a row the worker is not replaced, and
        the others continue. Raises DeviceError when no worker is left. Ctrl-C, and closing the
        generator early, end the workers.
        """
        waiting = deque(tasks)
        again = again or (lambda outcome: None)
        run = (function, contexts)  # its identity is that of this call
        try:
            while waiting or any(w.task is not None for w in self._workers):
                for outcome in self._some(run, waiting):
                    more = again(outcome) if outcome.reason is not None else None
                    if more is None:
                        yield outcome
                    else:
                        waiting.extendleft(reversed(list(more)))
        except BaseException:
            self.close()
            raise

    def _some(self, run, waiting):
        """Sends tasks to idle workers; returns the Outcomes of tasks that ended meanwhile."""
        if self.n_workers == 0:
            return [_in_this_process(run[0], run[1][0], waiting.popleft())]
        for worker in [w for w in self._workers if w.task is None and not w.process.is_alive()]:
            self._workers.remove(worker)  # killed while it had nothing to do
            _end(worker)
        busy = sum(worker.task is not None for worker in self._workers)
        self._added(max(0, len(waiting) + busy - len(self._workers)))
        for worker in self._workers:
            if worker.task is None and waiting:
                _give(worker, run, waiting.popleft())
        found = []
        for worker, outcome in _ended(self._workers, self.limit_s):
            broken = outcome.cause is Cause.DEVICE
            if broken or outcome.cause is Cause.WORKER:
                self._workers.remove(worker)
                _end(worker)
            else:
                worker.task, self._faults[worker.seat] = None, 0
            if broken:
                waiting.appendleft(outcome.task)
                self._count(worker.seat, outcome)
            else:
                found.append(outcome)
        return found

    def _added(self, most):
        """Starts workers on empty seats, a given number at most."""
        free = sorted(self._faults.keys() - {w.seat for w in self._workers})
        n_before = len(self._workers)
        for seat in free[:most]:
            self._workers.append(self._start(seat))
        return self._workers[n_before:]

    def _count(self, seat, outcome):
        """Counts a device's error.

        The worker is not replaced after too many; raises DeviceError with the last worker.
        """
        self._faults[seat] += 1
        if self._faults[seat] >= MAX_DEVICE_FAULTS:
            del self._faults[seat]
        if not self._faults:
            raise DeviceError(outcome.reason.message)


def _give(worker, run, task):
    """Sends a worker a task, before the first one also the data that tasks share."""
    worker.task, worker.since = task, time.monotonic()
    with contextlib.suppress(OSError):  # it has died, which is detected when its answer is read
        if worker.run is not run:
            function, contexts = run
            worker.pipe.send((function, contexts[worker.seat % len(contexts)]))
            worker.run = run
        worker.pipe.send((None, task))


def _in_this_process(function, context, task):
    """The Outcome of a task, without a worker. Raises DeviceError."""
    began = time.monotonic()
    try:
        value, reason = function(context, task), None
    except DeviceError:
        raise
    except Exception as error:
        value, reason = None, Reason.of(error)
    trim_memory()
    return Outcome(task, value, reason, start_s=began, end_s=time.monotonic())


def _starter(n_workers, bound):
    """Returns a function that starts a worker with its fraction of the processor's threads."""
    processes = multiprocessing.get_context("spawn")
    environment = thread_environment(n_workers)

    def start(seat):
        ours, theirs = processes.Pipe()
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update({k: v for k, v in environment.items() if before[k] is None})
        try:
            process = processes.Process(
                target=_work, args=(theirs, bound, os.getpid()), daemon=True
            )
            process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
        theirs.close()
        return _WorkerProcess(seat, process, ours)

    return start


def _ended(workers, limit_s):
    """Pairs (worker, Outcome) of tasks that have ended by now, after waiting for some."""
    busy = [worker for worker in workers if worker.task is not None]
    ready = set(wait([one for w in busy for one in (w.pipe, w.process.sentinel)], POLL_S))
    found, now = [], time.monotonic()
    for worker in busy:
        if worker.pipe in ready:
            try:
                value, reason, kernels = worker.pipe.recv()
                kernel_profiler.add(kernels)
            except (EOFError, OSError):
                value, reason = None, _dead(worker)
        elif worker.process.sentinel in ready:
            value, reason = None, _dead(worker)
        elif limit_s is not None and now - worker.since > limit_s:
            value, reason = None, took_too_long(limit_s)
        else:
            continue
        outcome = Outcome(worker.task, value, reason, worker.seat, worker.since, now)
        found.append((worker, outcome))
    return found


def took_too_long(limit_s):
    """The reason of a task that was ended with its worker."""
    return Reason(f"its worker took over {limit_s:g} s and was ended", Cause.WORKER)


def _dead(worker):
    """The reason of the task of a worker whose process has ended."""
    worker.process.join(5)
    code = worker.process.exitcode
    how = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
    return Reason(f"its worker ended with {how}", Cause.WORKER)


def _end(worker):
    """Ends a worker's process, busy or not."""
    worker.pipe.close()
    worker.process.terminate()
    worker.process.join(2)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(pipe, bound, parent):
    """Runs a worker until its end: reads functions, contexts and tasks, writes answers."""
    import signal

    limit_memory(bound)
    STRIPS.set_limit(bound)
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent ends its workers
    function = context = None
    kept = False
    while True:
        try:
            given, what = pipe.recv()
        except (EOFError, OSError):
            return
        if given is not None:
            function, context, kept = given, what, False
            unfreeze_objects()  # the last stage's context can be freed
            continue
        try:
            answer = function(context, what), None
        except KeyboardInterrupt:
            return
        except Exception as error:
            answer = None, Reason.of(error)
        try:
            pipe.send((*answer, kernel_profiler.drain()))
        except OSError:
            return
        del answer, what
        trim_memory()
        if not kept:  # the first task has loaded all modules and kernels
            freeze_objects()
            kept = True
