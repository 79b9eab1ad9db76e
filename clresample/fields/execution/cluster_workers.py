"""Workers of a cluster, which may join, leave or hang, with at most one task each."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

from ...device.discovery import DeviceError
from ...files.atomic import FileError
from .pool import MAX_DEVICE_FAULTS, Outcome, took_too_long
from .reason import Cause, Reason

RESTART_S = 30.0  # [s] time limit for ending a worker that hangs
# [s] Time without any worker after which a run fails: batch systems replace nodes in minutes.
NO_WORKER_TIMEOUT_S = 1800.0


@dataclass(eq=False)
class ClusterWorker:
    """One worker, with its task and the start time of the task.

    number: from 0 in the order in which workers joined; device: a choice for `get_device`
    context, future: Futures of the data shared by its tasks, and of the task
    faults: number of consecutive faults of its device
    """

    number: int
    address: str
    host: str
    device: object
    context: object = None
    task: object = None
    future: object = None
    start_s: float = 0.0
    faults: int = 0

    def outcome(self, value=None, reason=None) -> Outcome:
        """Outcome of its task, now."""
        now = time.monotonic()
        return Outcome(self.task, value, reason, self.number, self.start_s, now)


class ClusterWorkers:
    """All workers of a scheduler.

    client: distributed.Client; devices: dealt to the workers of each host by turns, empty = each
    worker's own; limit_s [s]: longest time of a task; progress: gets messages on lost workers
    """

    def __init__(self, client, devices, limit_s, progress):
        self.client, self.devices, self.limit_s = client, devices, limit_s
        self.progress, self.count = progress, 0
        self.there: dict[str, ClusterWorker] = {}
        self.given_up: set[str] = set()
        self.last_seen = time.monotonic()

    def __iter__(self):
        return iter(list(self.there.values()))

    @property
    def busy(self) -> list[ClusterWorker]:
        """Those that have a task."""
        return [seat for seat in self if seat.task is not None]

    def n_on_host(self, seat) -> int:
        """Number of workers, itself included, that share a worker's host."""
        return sum(other.host == seat.host for other in self)

    def release_all(self):
        """Releases all tasks and their shared data."""
        with contextlib.suppress(Exception):  # of a scheduler that is gone
            self.client.cancel([s.future for s in self if s.future is not None])
        for seat in self:
            seat.context = seat.task = seat.future = None

    def poll(self) -> list[Outcome]:
        """Adds new workers; returns the Outcomes of tasks whose workers died or hang.

        Raises FileError when none has been there for NO_WORKER_TIMEOUT_S.
        """
        now, found = set(self.client.nthreads()), []
        self.given_up &= now
        for address in [a for a in self.there if a not in now]:
            seat = self.there.pop(address)
            self.progress.message(f"worker {address} is gone")
            if seat.task is not None:
                gone = Reason(f"its worker {address} ended", Cause.WORKER)
                found.append(seat.outcome(reason=gone))
                self._cancel(seat)
        for address in sorted(now - self.there.keys() - self.given_up):
            self._add(address)
        for seat in self.busy:
            if self.limit_s is not None and time.monotonic() - seat.start_s > self.limit_s:
                found.append(seat.outcome(reason=took_too_long(self.limit_s)))
                self.end(seat)
        self._anybody()
        return found

    def _add(self, address):
        host = address.rpartition(":")[0].rpartition("/")[2]
        taken = [s.device for s in self if s.host == host]
        device = min(self.devices, key=taken.count) if self.devices else None
        self.there[address] = ClusterWorker(self.count, address, host, device)
        self.count += 1

    def _anybody(self):
        if self.there:
            self.last_seen = time.monotonic()
        elif time.monotonic() - self.last_seen > NO_WORKER_TIMEOUT_S:
            raise FileError(
                f"the scheduler has had no worker for {NO_WORKER_TIMEOUT_S:g} s; what is finished "
                f"stays: "
                "--resume goes on"
            )

    @staticmethod
    def _cancel(seat):
        """Cancels a task that its worker may still run, and ignores the answer."""
        future, seat.future = seat.future, None
        if future is not None:
            future.cancel()

    def end(self, seat):
        """Ends a worker; its nanny replaces it, without a nanny it leaves the cluster."""
        self.there.pop(seat.address, None)
        self._cancel(seat)
        try:
            self.client.restart_workers([seat.address], timeout=RESTART_S)
        except Exception:  # no nanny, or it hangs as well: the worker gets no more tasks
            self.given_up.add(seat.address)
            with contextlib.suppress(Exception):
                self.client.retire_workers([seat.address], close_workers=True, remove=True)

    def record_fault(self, seat, reason):
        """Counts a fault of a worker's device: after the second in a row it gets no more tasks.

        Raises DeviceError with the last worker.
        """
        seat.faults, seat.context = seat.faults + 1, None
        if seat.faults < MAX_DEVICE_FAULTS:
            return
        self.there.pop(seat.address, None)
        self.given_up.add(seat.address)
        self.progress.message(f"worker {seat.address} is given up: {reason}")
        if not self.there:
            raise DeviceError(reason.message)
