"""Backends of a field's tasks: processes of this machine, or workers of a cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ...files.atomic import atomic_file
from .pool import WorkerPool


@dataclass(frozen=True)
class TaskKind:
    """A task type in three steps: gather, compute, store.

    Only `compute` takes time; it needs no run folder.

    gather: called as gather(context, task), returns the task's inputs from the run's folder
    compute: called as compute(context, task, inputs), returns (value, content): a small value for
        the caller, and the bytes of the task's file
    path: called as path(context, task), returns the path of that file

    All are functions of modules, so that another process can import them. Calling the TaskKind runs
    all three in turn and returns the value.
    """

    gather: Callable
    compute: Callable
    path: Callable

    def __call__(self, context, task):
        value, content = self.compute(context, task, self.gather(context, task))
        self.keep(context, task, content)
        return value

    def keep(self, context, task, content):
        """Writes a task's file, whole or not at all. Raises FileError."""
        with atomic_file(self.path(context, task)) as part:
            part.write_bytes(content)


class LocalWorkers:
    """Processes of this machine, or this process itself.

    n_workers: 0 = this process; at least one for each device
    devices: choices as `get_device` takes them, dealt to the workers by turns; empty = the default
    limit_s [s], bound [bytes]: see `WorkerPool`
    turns: (stage, Outcome) of every task that has succeeded so far, with its times
    """

    def __init__(self, n_workers, devices=(), limit_s=None, bound=None):
        self.devices = tuple(devices) or (None,)
        several = len(self.devices) > 1
        self.n_workers = max(n_workers, len(self.devices)) if several else n_workers
        self.pool = WorkerPool(self.n_workers, limit_s, bound)
        self.turns: list[tuple] = []

    @property
    def device_shares(self) -> list[tuple]:
        """Each device, and the largest number of workers that share it."""
        n = -(-max(self.n_workers, 1) // len(self.devices))
        return [(device, n) for device in self.devices]

    def begin(self, work):
        """Starts the processes now and loads in them the modules of the work."""
        self.pool.begin(work)

    def run(self, work, context, tasks, again=None, stage=""):
        """Yields the Outcome of every task, as `WorkerPool.run` does."""
        contexts = [replace(context, device=device) for device in self.devices]
        for outcome in self.pool.run(work, contexts, tasks, again):
            if outcome.reason is None:
                self.turns.append((stage, outcome))
            yield outcome

    def close(self):
        """Ends the processes."""
        self.pool.close()


def make_backend(options, progress):
    """The backend of FieldOptions. Raises ImportError or ValueError for a cluster's."""
    devices = options.devices
    if options.scheduler is not None:
        from .cluster import DaskCluster

        return DaskCluster(options.scheduler, devices, options.task_timeout_s, progress)
    return LocalWorkers(options.workers, devices, options.task_timeout_s, options.worker_memory)
