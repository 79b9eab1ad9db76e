"""Tasks in worker processes that may fail, hang or be killed, none of which loses a task."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import time
import traceback
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import wait

from ...device.discovery import DeviceError

# [s] Between two looks at whether a worker takes too long.
LOOK_S = 1.0
# Device errors that follow each other, after each of which the worker gets a new process: one may
# be a driver that was reset, at the second the device itself is taken to be gone.
FAULTS = 2


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a task ended: its value, or the reason why there is none.

    worker_died: the reason is that the process ended or hung, not an error that it reported
    seat: which worker had it, from 0; began, ended [s]: by the monotonic clock
    """

    task: object
    value: object = None
    reason: str | None = None
    worker_died: bool = False
    seat: int = 0
    began: float = 0.0
    ended: float = 0.0


@dataclass(eq=False)
class _Worker:
    seat: int
    process: object
    pipe: object
    task: object = None
    since: float = 0.0


def run_tasks(function, contexts, tasks, n_workers, *, limit_s=None, again=None, bound=None):
    """Yield the Outcome of every task, as they end.

    function: called as function(context, task), in a module, so that a process can import it
    contexts: worker k gets the one numbered k modulo their number, pickled
    tasks: in the order in which they begin
    n_workers: processes; 0 runs all in this one, where errors are reported but nothing that ends
        a process is
    limit_s [s]: a task that takes longer is ended with its worker, which is replaced; None = none
    again: called with the Outcome of a task that failed; returns the tasks to run in its place, or
        None to let the Outcome stand. A failed task is yielded only where it stands
    bound [bytes]: private memory that a worker may take in all, held by the system; None = any

    A worker with a DeviceError gets a new process and the task waits again, which counts as no
    failure; at the next one in a row its seat stays empty, and the other workers go on. Raises
    DeviceError when no seat is left. Ctrl-C and a generator that is closed end the workers.
    """
    waiting = deque(tasks)
    again = again or (lambda outcome: None)
    if n_workers == 0:
        yield from _in_this_process(function, contexts[0], waiting, again)
        return
    workers: list[_Worker] = []
    faults = dict.fromkeys(range(n_workers), 0)
    start = _starter(function, contexts, n_workers, bound)
    try:
        while waiting or any(w.task is not None for w in workers):
            free = sorted(faults.keys() - {w.seat for w in workers})
            for seat in free[: max(0, len(waiting) + _busy(workers) - len(workers))]:
                workers.append(start(seat))
            for worker in workers:
                if worker.task is None and waiting:
                    worker.task, worker.since = waiting.popleft(), time.monotonic()
                    with contextlib.suppress(OSError):  # of one that has died: seen below
                        worker.pipe.send(worker.task)
            for worker, outcome in _ended(workers, limit_s):
                broken = (outcome.reason or "").startswith(DeviceError.__name__)
                if outcome.worker_died or broken:
                    workers.remove(worker)
                    _end(worker)
                else:
                    worker.task, faults[worker.seat] = None, 0
                if broken:
                    _count(faults, worker.seat, outcome)
                    waiting.appendleft(outcome.task)
                    continue
                more = again(outcome) if outcome.reason is not None else None
                if more is None:
                    yield outcome
                else:
                    waiting.extendleft(reversed(list(more)))
    finally:
        for worker in workers:
            _end(worker)


def _count(faults, seat, outcome):
    """Count a device's error; the seat goes when there were too many, DeviceError with the last."""
    faults[seat] += 1
    if faults[seat] >= FAULTS:
        del faults[seat]
    if not faults:
        raise DeviceError(outcome.reason.partition(": ")[2])


def _in_this_process(function, context, waiting, again):
    """The tasks one after the other, without workers."""
    while waiting:
        task, began = waiting.popleft(), time.monotonic()
        try:
            value, reason = function(context, task), None
        except DeviceError:
            raise
        except Exception as error:
            value, reason = None, reason_of(error)
        outcome = Outcome(task, value, reason, began=began, ended=time.monotonic())
        more = again(outcome) if outcome.reason is not None else None
        if more is None:
            yield outcome
        else:
            waiting.extendleft(reversed(list(more)))


def _busy(workers):
    return sum(worker.task is not None for worker in workers)


def shared_threads(n_workers) -> dict:
    """Environment of a worker that shares this machine's processor with so many, itself included.

    NumPy's libraries get one thread, PoCL's CPU device its part of all, by the names of its older
    and newer versions.
    """
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if n_workers > 1:
        n_threads = max(1, (os.cpu_count() or 1) // n_workers)
        names = "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"
        environment |= dict.fromkeys(names, str(n_threads))
    return environment


def _starter(function, contexts, n_workers, bound):
    """What makes the worker of a seat. Each gets its part of the processor's threads."""
    processes = multiprocessing.get_context("spawn")
    environment = shared_threads(n_workers)

    def start(seat):
        ours, theirs = processes.Pipe()
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update({k: v for k, v in environment.items() if before[k] is None})
        try:
            process = processes.Process(target=_work, args=(theirs, function, bound), daemon=True)
            process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
        theirs.close()
        # Not as an argument of the process: what is larger than the system's buffer would wait for
        # ever to be read by a process that was killed before it had read it.
        with contextlib.suppress(OSError):  # of one that has died: seen when it gets a task
            ours.send(contexts[seat % len(contexts)])
        return _Worker(seat, process, ours)

    return start


def _ended(workers, limit_s):
    """Pairs (worker, Outcome) of tasks that have ended by now, after waiting for some."""
    busy = [worker for worker in workers if worker.task is not None]
    ready = set(wait([one for w in busy for one in (w.pipe, w.process.sentinel)], LOOK_S))
    found, now = [], time.monotonic()
    for worker in busy:
        if worker.pipe in ready:
            try:
                value, reason = worker.pipe.recv()
                died = False
            except (EOFError, OSError):
                value, reason, died = None, _dead(worker), True
        elif worker.process.sentinel in ready:
            value, reason, died = None, _dead(worker), True
        elif limit_s is not None and now - worker.since > limit_s:
            value, reason, died = None, took_too_long(limit_s), True
        else:
            continue
        outcome = Outcome(worker.task, value, reason, died, worker.seat, worker.since, now)
        found.append((worker, outcome))
    return found


def took_too_long(limit_s):
    """The reason of a task that was ended with its worker."""
    return f"its worker took over {limit_s:g} s and was ended"


def _dead(worker):
    """The reason of the task of a worker whose process has ended."""
    worker.process.join(5)
    code = worker.process.exitcode
    how = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
    return f"its worker ended with {how}"


def _end(worker):
    """End a worker's process, whatever it does."""
    worker.pipe.close()
    worker.process.terminate()
    worker.process.join(2)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(pipe, function, bound):
    """A worker: the context and tasks from the pipe, answers into it, until its end is closed."""
    import signal

    hold_memory(bound)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent ends its workers
    try:
        context = pipe.recv()
    except (EOFError, OSError):
        return
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = function(context, task), None
        except KeyboardInterrupt:
            return
        except Exception as error:
            answer = None, reason_of(error)
        try:
            pipe.send(answer)
        except OSError:
            return


def hold_memory(bound):
    """Have the system refuse this process private memory beyond so many bytes, where it can.

    What is refused is a MemoryError, or a device's, which costs a group of fits its batch: they are
    fitted one by one. Files that are mapped do not count (RLIMIT_DATA of Linux).
    """
    if bound is None or not sys.platform.startswith("linux"):
        return
    import resource

    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    if most == resource.RLIM_INFINITY or bound < most:
        resource.setrlimit(resource.RLIMIT_DATA, (int(bound), most))


def reason_of(error):
    """An error in one line, with the place where it was raised."""
    text = " ".join(str(error).split()) or "no message"
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} ({last.name}, line {last.lineno})"
