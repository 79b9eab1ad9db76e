"""Workers of a cluster, which may join, leave or hang, with at most one task each."""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import secrets
import time
import warnings
from dataclasses import dataclass, field, replace
from typing import Any

from ...device.device import get_device
from ...device.discovery import DeviceError
from ...device.workers.crew import POLL_S, Crew, Worker
from ...device.workers.outcome import Cause, Reason
from ...device.workers.process_limits import thread_environment, trim_memory
from ...files.atomic import FileError
from ..strips import STRIPS
from .reason import reason_of

FETCH_S = 60.0  # [s] within which a finished task's file must have come from its worker
RESTART_S = 30.0  # [s] time limit for ending a worker that hangs
# [s] Time without any worker after which a run fails: batch systems replace nodes in minutes.
NO_WORKER_TIMEOUT_S = 1800.0


@dataclass(eq=False)
class ClusterWorker(Worker):
    """One worker, numbered in the order in which workers joined.

    device: a choice for `get_device`
    context, future: Futures of the data shared by its tasks, and of the task
    """

    address: str = ""
    host: str = ""
    device: Any = None
    context: Any = None
    future: Any = None


@dataclass(eq=False)
class ClusterJob:
    """Constants of a run: its TaskKind and context, and the context pickled for each device."""

    work: Any
    context: Any
    blobs: dict = field(default_factory=dict)


class ClusterWorkers(Crew):
    """All workers of a scheduler.

    client: distributed.Client; devices: dealt to the workers of each host by turns, empty = each
    worker's own; limit_s [s]: longest time of a task; progress: gets messages on lost workers
    """

    def __init__(self, client, devices, limit_s, progress):
        self.client, self.devices, self.limit_s = client, devices, limit_s
        self.progress, self.count = progress, 0
        self.there: dict[str, ClusterWorker] = {}
        self.given_up: set[str] = set()
        self.last_seen, self.looked = time.monotonic(), 0.0
        self._failed: list[tuple] = []  # (worker, Outcome) without an answer
        self._answers: queue.Queue = queue.Queue()  # (worker, future)

    @property
    def workers(self):
        """Those that are there."""
        return list(self.there.values())

    def release_all(self):
        """Releases all tasks and their shared data."""
        with contextlib.suppress(Exception):  # of a scheduler that is gone
            self.client.cancel([w.future for w in self.workers if w.future is not None])
        for worker in self.workers:
            worker.context = worker.task = worker.future = None
        self._failed.clear()

    def ready(self, n_tasks):
        """Idle workers for a number of tasks, with those that joined since the last look."""
        if time.monotonic() - self.looked > POLL_S:
            self._look()
            self.looked = time.monotonic()
        return [worker for worker in self.workers if worker.task is None][:n_tasks]

    def send(self, worker, job):
        """Sends a worker its task with its inputs, before the first one also the context."""
        try:
            given = job.work.gather(job.context, worker.task)
        except Exception as error:
            self._failed.append((worker, worker.outcome(reason=reason_of(error))))
            return
        if worker.context is None:
            if worker.device not in job.blobs:
                job.blobs[worker.device] = pickle.dumps(replace(job.context, device=worker.device))
            n_on_host = sum(other.host == worker.host for other in self.workers)
            shared = job.blobs[worker.device], n_on_host
            worker.context = self._submit(worker, _opened, *shared)
        parcel = pickle.dumps((job.work.compute, worker.task, given))
        worker.future = self._submit(worker, _done, worker.context, parcel)
        worker.future.add_done_callback(lambda future: self._answers.put((worker, future)))

    def ended(self, job):
        """Pairs (worker, Outcome) of tasks that have ended by now, after waiting for one."""
        found, self._failed = self._failed, []
        if found:
            return found
        try:
            worker, future = self._answers.get(timeout=POLL_S)
        except queue.Empty:
            return []
        if worker.future is not future:  # of a worker that was given up
            return []
        outcome = worker.outcome(*self._answer(worker, job))
        worker.future = None
        return [(worker, outcome)]

    def renew(self, worker):
        """Makes a worker open its device again before its next task."""
        worker.context = None

    def drop(self, worker, reason):
        """Gives a worker no more tasks."""
        self.there.pop(worker.address, None)
        self.given_up.add(worker.address)
        self.progress.message(f"worker {worker.address} is given up: {reason}")

    def _answer(self, worker, job):
        """(value, reason) of a finished task; stores its file."""
        try:
            (value, content), reason = worker.future.result(timeout=FETCH_S)
        except DeviceError as error:  # as the worker opened it
            return None, Reason(str(error), Cause.DEVICE, type(error).__name__)
        except Exception as error:
            why = f"its worker {worker.address} ended ({error or worker.future.status})"
            self._end(worker)
            return None, Reason(why, Cause.WORKER)
        if reason is None:
            try:
                job.work.keep(job.context, worker.task, content)
            except Exception as error:
                return None, reason_of(error)
        return value, reason

    def _submit(self, worker, function, *arguments):
        """Future of a call on one worker and no other."""
        where = {"workers": [worker.address], "allow_other_workers": False, "pure": False}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about the size of sent data
            key = f"clresample{function.__name__}-{secrets.token_hex(8)}"
            return self.client.submit(function, *arguments, key=key, **where)

    def _look(self):
        """Adds new workers; ends tasks whose workers died or hang.

        Raises FileError when none has been there for NO_WORKER_TIMEOUT_S.
        """
        now = set(self.client.nthreads())
        self.given_up &= now
        for address in [a for a in self.there if a not in now]:
            worker = self.there.pop(address)
            self.progress.message(f"worker {address} is gone")
            if worker.task is not None:
                gone = Reason(f"its worker {address} ended", Cause.WORKER)
                self._failed.append((worker, worker.outcome(reason=gone)))
                self._cancel(worker)
        for address in sorted(now - self.there.keys() - self.given_up):
            self._add(address)
        for worker in self.workers:
            if outcome := worker.overtime(self.limit_s):
                self._failed.append((worker, outcome))
                self._end(worker)
        if self.there:
            self.last_seen = time.monotonic()
        elif time.monotonic() - self.last_seen > NO_WORKER_TIMEOUT_S:
            raise FileError(
                f"the scheduler has had no worker for {NO_WORKER_TIMEOUT_S:g} s; what is finished "
                "stays: --resume goes on"
            )

    def _add(self, address):
        host = address.rpartition(":")[0].rpartition("/")[2]
        taken = [worker.device for worker in self.workers if worker.host == host]
        device = min(self.devices, key=taken.count) if self.devices else None
        self.there[address] = ClusterWorker(self.count, address=address, host=host, device=device)
        self.count += 1

    @staticmethod
    def _cancel(worker):
        """Cancels a task that its worker may still run, and ignores the answer."""
        future, worker.future = worker.future, None
        if future is not None:
            future.cancel()

    def _end(self, worker):
        """Ends a worker; its nanny replaces it, without a nanny it leaves the cluster."""
        self.there.pop(worker.address, None)
        self._cancel(worker)
        try:
            self.client.restart_workers([worker.address], timeout=RESTART_S)
        except Exception:  # no nanny, or it hangs as well: the worker gets no more tasks
            self.given_up.add(worker.address)
            with contextlib.suppress(Exception):
                self.client.retire_workers([worker.address], close_workers=True, remove=True)


def _opened(blob, n_beside):
    """The context on a worker, with the number of workers on its host's processor."""
    from distributed import get_worker

    for name, value in thread_environment(n_beside).items():
        os.environ.setdefault(name, value)
    STRIPS.set_limit(get_worker().memory_manager.memory_limit or None)  # 0 and None: any
    context = pickle.loads(blob)
    get_device(context.device)
    return context


def _done(context, parcel):
    """((value, content), reason) of one task on a worker."""
    done, task, given = pickle.loads(parcel)
    try:
        return done(context, task, given), None
    except Exception as error:
        return (None, None), reason_of(error)
    finally:
        trim_memory()
