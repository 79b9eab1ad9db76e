"""Tasks in worker processes that may fail, hang or be killed, none of which loses a task."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
import traceback
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import wait

# [s] Between two looks at whether a worker takes too long.
LOOK_S = 1.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a task ended: its value, or the reason why there is none.

    worker_died: the reason is that the process ended or hung, not an error that it reported
    """

    task: object
    value: object = None
    reason: str | None = None
    worker_died: bool = False


@dataclass(eq=False)
class _Worker:
    process: object
    pipe: object
    task: object = None
    since: float = 0.0


def run_tasks(function, context, tasks, n_workers, *, limit_s=None, again=None):
    """Yield the Outcome of every task, as they end.

    function: called as function(context, task), in a module, so that a process can import it
    context: the same for all tasks; pickled once for each worker
    tasks: in the order in which they begin
    n_workers: processes; 0 runs all in this one, where errors are reported but nothing that ends
        a process is
    limit_s [s]: a task that takes longer is ended with its worker, which is replaced; None = none
    again: called with the Outcome of a task that failed; returns the tasks to run in its place, or
        None to let the Outcome stand. A failed task is yielded only where it stands

    Ctrl-C and a generator that is closed end the workers.
    """
    waiting = deque(tasks)
    again = again or (lambda outcome: None)
    if n_workers == 0:
        yield from _in_this_process(function, context, waiting, again)
        return
    workers: list[_Worker] = []
    start = _starter(function, context, n_workers)
    try:
        while waiting or any(w.task is not None for w in workers):
            while len(workers) < n_workers and len(workers) < len(waiting) + _busy(workers):
                workers.append(start())
            for worker in workers:
                if worker.task is None and waiting:
                    worker.task, worker.since = waiting.popleft(), time.monotonic()
                    with contextlib.suppress(OSError):  # of one that has died: seen below
                        worker.pipe.send(worker.task)
            for worker, outcome in _ended(workers, limit_s):
                if outcome.worker_died:
                    workers.remove(worker)
                    _end(worker)
                else:
                    worker.task = None
                more = again(outcome) if outcome.reason is not None else None
                if more is None:
                    yield outcome
                else:
                    waiting.extendleft(reversed(list(more)))
    finally:
        for worker in workers:
            _end(worker)


def _in_this_process(function, context, waiting, again):
    """The tasks one after the other, without workers."""
    while waiting:
        task = waiting.popleft()
        try:
            outcome = Outcome(task, function(context, task))
        except Exception as error:
            outcome = Outcome(task, reason=_reason(error))
        more = again(outcome) if outcome.reason is not None else None
        if more is None:
            yield outcome
        else:
            waiting.extendleft(reversed(list(more)))


def _busy(workers):
    return sum(worker.task is not None for worker in workers)


def _starter(function, context, n_workers):
    """What makes a worker. Each gets its part of the processor's threads."""
    processes = multiprocessing.get_context("spawn")
    n_threads = max(1, (os.cpu_count() or 1) // n_workers)
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if n_workers > 1:  # PoCL's CPU device, by the names of its older and newer versions
        environment |= dict.fromkeys(
            ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"), str(n_threads)
        )

    def start():
        ours, theirs = processes.Pipe()
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update({k: v for k, v in environment.items() if before[k] is None})
        try:
            process = processes.Process(target=_work, args=(theirs, function), daemon=True)
            process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
        theirs.close()
        # Not as an argument of the process: what is larger than the system's buffer would wait for
        # ever to be read by a process that was killed before it had read it.
        with contextlib.suppress(OSError):  # of one that has died: seen when it gets a task
            ours.send(context)
        return _Worker(process, ours)

    return start


def _ended(workers, limit_s):
    """Pairs (worker, Outcome) of tasks that have ended by now, after waiting for some."""
    busy = [worker for worker in workers if worker.task is not None]
    ready = set(wait([one for w in busy for one in (w.pipe, w.process.sentinel)], LOOK_S))
    found = []
    for worker in busy:
        if worker.pipe in ready:
            try:
                value, reason = worker.pipe.recv()
            except (EOFError, OSError):
                found.append((worker, _dead(worker)))
            else:
                found.append((worker, Outcome(worker.task, value, reason)))
        elif worker.process.sentinel in ready:
            found.append((worker, _dead(worker)))
        elif limit_s is not None and time.monotonic() - worker.since > limit_s:
            reason = f"its worker took over {limit_s:g} s and was ended"
            found.append((worker, Outcome(worker.task, reason=reason, worker_died=True)))
    return found


def _dead(worker):
    """The Outcome of the task of a worker whose process has ended."""
    worker.process.join(5)
    code = worker.process.exitcode
    how = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
    return Outcome(worker.task, reason=f"its worker ended with {how}", worker_died=True)


def _end(worker):
    """End a worker's process, whatever it does."""
    worker.pipe.close()
    worker.process.terminate()
    worker.process.join(2)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(pipe, function):
    """A worker: the context and tasks from the pipe, answers into it, until its end is closed."""
    import signal

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
            answer = None, _reason(error)
        try:
            pipe.send(answer)
        except OSError:
            return


def _reason(error):
    """An error in one line, with the place where it was raised."""
    text = " ".join(str(error).split()) or "no message"
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} ({last.name}, line {last.lineno})"
