"""Backends of a field's tasks: processes of this machine, or workers of a cluster."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from ...device.workers.pool import WorkerPool
from ..strips import STRIPS
from .reason import reason_of
from .tasks import Backend


class LocalWorkers(Backend):
    """Processes of this machine, or this process itself.

    n_workers: 0 = this process; at least one for each device
    devices: choices as `get_device` takes them, dealt to the workers by turns; empty = the default
    limit_s [s], bound [bytes]: see `WorkerPool`
    """

    def __init__(self, n_workers, devices=(), limit_s=None, bound=None):
        super().__init__()
        self.devices = tuple(devices) or (None,)
        several = len(self.devices) > 1
        self.n_workers = max(n_workers, len(self.devices)) if several else n_workers
        setup = partial(_limit_strips, bound)
        self.pool = WorkerPool(self.n_workers, limit_s, bound, setup=setup, reason_of=reason_of)

    @property
    def device_shares(self):
        """Each device, and the largest number of workers that share it."""
        n = -(-max(self.n_workers, 1) // len(self.devices))
        return [(device, n) for device in self.devices]

    def begin(self, work):
        """Starts the processes now and loads in them the modules of the work."""
        self.pool.begin(work)

    def outcomes(self, work, context, tasks, again=None):
        """Yields the Outcome of every task."""
        contexts = [replace(context, device=device) for device in self.devices]
        return self.pool.run(work, contexts, tasks, again)

    def close(self):
        """Ends the processes."""
        self.pool.close()


def _limit_strips(bound):
    """Limits the decoded rows that a worker keeps by its memory [bytes]."""
    STRIPS.set_limit(bound)


def make_backend(options, progress) -> Backend:
    """The backend of FieldOptions. Raises ImportError or ValueError for a cluster's."""
    devices = options.devices
    if options.scheduler is not None:
        from .cluster import DaskCluster

        return DaskCluster(options.scheduler, devices, options.task_timeout_s, progress)
    return LocalWorkers(options.workers, devices, options.task_timeout_s, options.worker_memory)
