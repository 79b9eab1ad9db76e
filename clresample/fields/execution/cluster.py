"""Tasks on the workers of a `dask.distributed` cluster, any of which may fail, hang or go away.

Each worker has one task at a time, sent to it by name. So the largest tasks begin first, one device
serves one fit, and the task of a lost worker is known. The inputs from the run's folder and the
resulting file are sent as bytes, so workers need access only to the files of the mosaics.
"""

from __future__ import annotations

import os
import pickle
import queue
import secrets
import time
import warnings
from collections import deque
from dataclasses import replace

from ... import __version__
from ...device.device import get_device
from ...device.discovery import DeviceError
from ...files.atomic import FileError
from ..strips import STRIPS
from .cluster_workers import ClusterWorkers
from .pool import POLL_S
from .process_limits import thread_environment, trim_memory
from .reason import Cause, Reason

NO_DASK = "distributed is not installed (pip install distributed)"
CONNECT_S = 30.0  # [s] within which the scheduler answers and its first worker is there
FETCH_S = 60.0  # [s] within which a finished task's file must have come from its worker


class DaskCluster:
    """The workers of a scheduler.

    address: of the scheduler, as `distributed.Client` takes it
    devices: choices as `get_device` takes them, dealt to the workers of each host by turns; empty =
        each worker's own, which its environment's CLRESAMPLE_DEVICE names
    limit_s [s]: a task that takes longer is ended with its worker
    progress: RunProgress, which receives the dashboard's address and messages on lost workers
    turns: (stage, Outcome) of every task that has succeeded so far

    Raises ImportError without distributed; ValueError if the scheduler does not answer, has no
    worker, or a worker has another version of this package.
    """

    def __init__(self, address, devices, limit_s, progress):
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError(NO_DASK) from error
        self.address, self.turns = address, []
        try:
            self.client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"scheduler {address!r} does not answer ({error})") from error
        self.seats = ClusterWorkers(self.client, tuple(devices), limit_s, progress)
        try:
            self._check()
        except BaseException:
            self.close()
            raise
        progress.dashboard(self.client.dashboard_link)

    def _check(self):
        """Raises an error for a cluster without workers, or with workers that cannot run ours."""
        try:
            self.client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError as error:
            raise ValueError(f"scheduler {self.address!r} has no worker") from error
        try:
            versions = self.client.run(_version)
        except Exception as error:
            raise ValueError(
                f"scheduler {self.address!r}: a worker cannot import clresample "
                f"({' '.join(str(error).split())}): install {__version__} there"
            ) from error
        for worker, found in versions.items():
            if found != __version__:
                raise ValueError(f"worker {worker} has clresample {found}, this is {__version__}")

    @property
    def device_shares(self) -> list[tuple]:
        """Each device, and the number of workers that share it: one."""
        return [(device, 1) for device in self.seats.devices or (None,)]

    def close(self):
        """Leaves the cluster as it is."""
        self.client.close()

    def begin(self, work):
        """The workers run already."""

    def run(self, work, context, tasks, again=None, stage=""):
        """Yields the Outcome of every task, as `WorkerPool.run` does.

        Raises DeviceError when every worker's device fails, FileError when the scheduler is gone or
        no worker has come for long.
        """
        again = again or (lambda outcome: None)
        run = _Run(self.client, self.seats, work, context, deque(tasks))
        try:
            for outcome in run.outcomes():
                more = again(outcome) if outcome.reason is not None else None
                if more is not None:
                    run.waiting.extendleft(reversed(list(more)))
                    continue
                if outcome.reason is None:
                    self.turns.append((stage, outcome))
                yield outcome
        except _lost() as error:
            raise FileError(
                f"the scheduler {self.address} no longer answers ({Reason.of(error)}); what is "
                "finished stays: --resume goes on"
            ) from error
        finally:
            self.seats.release_all()


class _Run:
    """Unfinished tasks of one stage.

    waiting: tasks without a worker; ended: (seat, its future) of finished tasks
    """

    def __init__(self, client, seats, work, context, waiting):
        self.client, self.seats, self.work, self.context = client, seats, work, context
        self.waiting, self.blobs = waiting, {}
        self.ended: queue.Queue = queue.Queue()

    def outcomes(self):
        """Yields the Outcomes of all tasks, failed ones included."""
        looked = 0.0
        while self.waiting or self.seats.busy:
            if time.monotonic() - looked > POLL_S:
                yield from self.seats.poll()
                looked = time.monotonic()
            for seat in self.seats:
                if seat.task is None and self.waiting and (failed := self._give(seat)):
                    yield failed
            if outcome := self._next():
                yield outcome

    def _give(self, seat):
        """Sends a worker the next task; returns an Outcome if the task's inputs cannot be read."""
        seat.task, seat.start_s = self.waiting.popleft(), time.monotonic()
        try:
            given = self.work.gather(self.context, seat.task)
        except Exception as error:
            failed, seat.task = seat.outcome(reason=Reason.of(error)), None
            return failed
        if seat.context is None:
            if seat.device not in self.blobs:
                self.blobs[seat.device] = pickle.dumps(replace(self.context, device=seat.device))
            shared = self.blobs[seat.device], self.seats.n_on_host(seat)
            seat.context = self._submit(seat, _opened, *shared)
        seat.future = self._submit(
            seat, _done, seat.context, pickle.dumps((self.work.compute, seat.task, given))
        )
        seat.future.add_done_callback(lambda future: self.ended.put((seat, future)))
        return None

    def _submit(self, seat, function, *arguments):
        """Future of a call on one worker and no other."""
        where = {"workers": [seat.address], "allow_other_workers": False, "pure": False}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about the size of sent data
            key = f"clresample{function.__name__}-{secrets.token_hex(8)}"
            return self.client.submit(function, *arguments, key=key, **where)

    def _next(self):
        """The Outcome of a task that has ended within POLL_S, or None."""
        try:
            seat, future = self.ended.get(timeout=POLL_S)
        except queue.Empty:
            return None
        if seat.future is not future:  # of a worker that was given up
            return None
        outcome = seat.outcome(*self._answer(seat, future))
        seat.task = seat.future = None
        if outcome.cause is Cause.DEVICE:
            self.waiting.appendleft(outcome.task)
            self.seats.record_fault(seat, outcome.reason)
            return None
        seat.faults = 0
        return outcome

    def _answer(self, seat, future):
        """(value, reason) of a finished task; stores its file."""
        try:
            (value, content), reason = future.result(timeout=FETCH_S)
        except DeviceError as error:  # as the worker opened it
            return None, Reason(str(error), Cause.DEVICE, type(error).__name__)
        except Exception as error:
            self.seats.end(seat)
            why = f"its worker {seat.address} ended ({error or future.status})"
            return None, Reason(why, Cause.WORKER)
        if reason is None:
            try:
                self.work.keep(self.context, seat.task, content)
            except Exception as error:
                return None, Reason.of(error)
        return value, reason


def _lost():
    """Errors that a client raises whose scheduler is gone."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    return CommClosedError, ConnectionError, TimeoutError, CancelledError


def _version():
    """Of this package on a worker."""
    return __version__


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
        return (None, None), Reason.of(error)
    finally:
        trim_memory()
