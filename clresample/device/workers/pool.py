"""Runs tasks in worker processes that may fail, hang or be killed, without losing a task."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
import types
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

from .. import kernel_profiler
from ..discovery import DeviceError
from .crew import POLL_S, Crew, TaskQueue, Worker
from .outcome import Cause, Reason
from .process_limits import (
    die_with_parent,
    limit_memory,
    thread_environment,
    trim_memory,
)


@dataclass(eq=False)
class _WorkerProcess(Worker):
    """process, pipe: None before it is started; job: whose function and context it has"""

    process: Any = None
    pipe: Any = None
    job: Any = None

    def end(self):
        """Ends its process, busy or not."""
        if self.process is None:
            return
        self.pipe.close()
        if self.task is None:  # an idle one ends by itself: a signal on its way would be reported
            self.process.join(2)
        self.process.terminate()
        self.process.join(2)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process = self.pipe = self.job = None

    def answer(self):
        """The Outcome that its process has sent, or that of its death."""
        try:
            value, reason, kernels = self.pipe.recv()
            kernel_profiler.add(kernels)
        except (EOFError, OSError):
            return self.death()
        return self.outcome(value, reason)

    def death(self):
        """The Outcome of its task after its process has ended."""
        self.process.join(5)
        code = self.process.exitcode
        how = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
        return self.outcome(reason=Reason(f"its worker ended with {how}", Cause.WORKER))


class WorkerPool(Crew):
    """Worker processes, started when there is work for them, alive until `close`.

    n_workers: processes; 0 = all in this one, where errors are reported but a crash is not
    limit_s [s]: a task that takes longer is ended with its worker, which is replaced; None = none
    bound [bytes]: limit on a worker's private memory, enforced by the system; None = any
    environment: of the processes, where this one does not set it; None = each has its fraction of
        the processor's threads
    setup: called without arguments by each process first; None = nothing
    reason_of: makes the Reason of an exception of a task
    imports_main: processes import the caller's script, as Python's own do, so that it must be
        guarded by `if __name__ == "__main__":`; without it tasks cannot name what it defines

    `setup` and `reason_of` belong to modules, so that a process can import them. A context manager,
    which closes it.
    """

    def __init__(
        self,
        n_workers,
        limit_s=None,
        bound=None,
        *,
        environment=None,
        setup=None,
        reason_of=Reason.of,
        imports_main=True,
    ):
        self.n_workers, self.limit_s = n_workers, limit_s
        self.environment = thread_environment(n_workers) if environment is None else environment
        self._given, self._imports_main = (bound, setup, reason_of), imports_main
        self.workers = [_WorkerProcess(number) for number in range(n_workers)]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Ends all workers, busy ones included."""
        for worker in self.workers:
            worker.end()
            worker.task = None

    def begin(self, function):
        """Starts every worker now and loads in it the modules of the function."""
        for worker in self.workers:
            if worker.process is None:
                self._start(worker)
                with contextlib.suppress(OSError):  # it has died: its successor loads the modules
                    worker.pipe.send((function, None))

    def run(self, function, contexts, tasks, again=None):
        """Yields the Outcome of every task, as they end; see `Crew.outcomes`.

        function: called as function(context, task), in a module, so that a process can import it
        contexts: worker k gets the context numbered k modulo their number, pickled
        tasks: in the order in which they begin, or a TaskQueue

        Ctrl-C, and closing the generator early, end the workers.
        """
        queue = tasks if isinstance(tasks, TaskQueue) else TaskQueue(tasks)
        job = (function, contexts)  # its identity is that of this call
        crew = self if self.n_workers else _ThisProcess(self._given[-1])
        try:
            yield from crew.outcomes(job, queue, again)
        except BaseException:
            self.close()
            raise

    def ready(self, n_tasks):
        """Idle workers for a number of tasks, with a process each; started ones first."""
        idle = [worker for worker in self.workers if worker.task is None]
        for worker in idle:
            if worker.process is not None and not worker.process.is_alive():
                worker.end()  # killed while it had nothing to do
        idle = sorted(idle, key=lambda worker: worker.process is None)[:n_tasks]
        for worker in idle:
            if worker.process is None:
                self._start(worker)
        return idle

    def send(self, worker, job):
        """Sends a worker its task, before the first one also the data that tasks share."""
        with contextlib.suppress(OSError):  # it has died, which is detected when its answer is read
            if worker.job is not job:
                function, contexts = job
                worker.pipe.send((function, contexts[worker.number % len(contexts)]))
                worker.job = job
            worker.pipe.send((None, worker.task))

    def ended(self, job):
        """Yields (worker, Outcome) of tasks that have ended by now, after waiting for some."""
        busy = self.busy
        ready = set(wait([one for w in busy for one in (w.pipe, w.process.sentinel)], POLL_S))
        for worker in busy:
            if worker.pipe in ready:
                outcome = worker.answer()
            elif worker.process.sentinel in ready:
                outcome = worker.death()
            else:
                outcome = worker.overtime(self.limit_s)
            if outcome is None:
                continue
            if outcome.cause is Cause.WORKER:
                worker.end()
            yield worker, outcome

    def drop(self, worker, reason):
        """Removes a worker whose device is lost."""
        self.workers.remove(worker)

    def renew(self, worker):
        """Ends a worker's process, so that its next task gets a new one."""
        worker.end()

    def interrupted(self, limit_s):
        """Sends SIGTERM to all workers; yields Outcomes that busy ones still return in time [s]."""
        for worker in self.workers:
            if worker.process is not None:
                worker.process.terminate()
        for worker in self.busy:
            if worker.pipe.poll(limit_s):
                outcome = worker.answer()
                if outcome.reason is None:
                    yield outcome

    def _start(self, worker):
        processes = multiprocessing.get_context("spawn")
        ours, theirs = processes.Pipe()
        before = {name: os.environ.get(name) for name in self.environment}
        os.environ.update({k: v for k, v in self.environment.items() if before[k] is None})
        try:
            process = processes.Process(
                target=_work, args=(theirs, os.getpid(), *self._given), daemon=True
            )
            with contextlib.nullcontext() if self._imports_main else _without_main():
                process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
        theirs.close()
        worker.process, worker.pipe = process, ours


@contextlib.contextmanager
def _without_main():
    """Context in which processes start as if the caller's script were empty."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _work(pipe, parent, bound, setup, reason_of):
    """Runs a worker until its end: reads functions, contexts and tasks, writes answers."""
    limit_memory(bound)
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent ends its workers
    if setup is not None:
        setup()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        _answer_all(pipe, reason_of)
    os._exit(0)  # skips the exit handlers of drivers, some of which wait for ever


def _answer_all(pipe, reason_of):
    """Answers tasks. Raises EOFError or OSError when the parent has closed the pipe."""
    function = context = None
    kept = False
    while True:
        given, what = pipe.recv()
        if given is not None:
            function, context, kept = given, what, False
            gc.unfreeze()  # the last stage's context can be freed
            continue
        try:
            answer = function(context, what), None
        except Exception as error:
            answer = None, reason_of(error)
        pipe.send((*answer, kernel_profiler.drain()))
        del answer, what
        trim_memory()
        if not kept:  # the first task has loaded all modules and kernels: without these a
            gc.freeze()  # collection takes 1 ms instead of 70
            kept = True


class _ThisProcess(Crew):
    """The calling process, which computes a task when it is sent; raises DeviceErrors."""

    def __init__(self, reason_of):
        self.workers, self.reason_of, self.found = [Worker(0)], reason_of, []

    def ready(self, n_tasks):
        return self.workers

    def send(self, worker, job):
        function, contexts = job
        try:
            outcome = worker.outcome(function(contexts[0], worker.task))
        except DeviceError:
            raise
        except Exception as error:
            outcome = worker.outcome(reason=self.reason_of(error))
        self.found = [(worker, outcome)]
        trim_memory()

    def ended(self, job):
        return self.found
