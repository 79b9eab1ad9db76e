"""Tasks on the workers of a `dask.distributed` cluster, any of which may fail, hang or go away.

Each worker has one task at a time, sent to it by name. So the largest tasks begin first, one device
serves one fit, and the task of a lost worker is known. The inputs from the run's folder and the
resulting file are sent as bytes, so workers need access only to the files of the mosaics.
"""

from __future__ import annotations

from ... import __version__
from ...device.workers.crew import TaskQueue
from ...files.atomic import FileError
from .cluster_workers import ClusterJob, ClusterWorkers
from .reason import reason_of
from .tasks import Backend

NO_DASK = "distributed is not installed (pip install distributed)"
CONNECT_S = 30.0  # [s] within which the scheduler answers and its first worker is there


class DaskCluster(Backend):
    """The workers of a scheduler.

    address: of the scheduler, as `distributed.Client` takes it
    devices: choices as `get_device` takes them, dealt to the workers of each host by turns; empty =
        each worker's own, which its environment's CLRESAMPLE_DEVICE names
    limit_s [s]: a task that takes longer is ended with its worker
    progress: RunProgress, which receives the dashboard's address and messages on lost workers

    Raises ImportError without distributed; ValueError if the scheduler does not answer, has no
    worker, or a worker has another version of this package.
    """

    def __init__(self, address, devices, limit_s, progress):
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError(NO_DASK) from error
        super().__init__()
        self.address = address
        try:
            self.client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"scheduler {address!r} does not answer ({error})") from error
        self.crew = ClusterWorkers(self.client, tuple(devices), limit_s, progress)
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
    def device_shares(self):
        """Each device, and the number of workers that share it: one."""
        return [(device, 1) for device in self.crew.devices or (None,)]

    @property
    def n_workers(self) -> int:
        """Number of workers that the cluster has now."""
        return len(self.client.scheduler_info()["workers"])

    def close(self):
        """Leaves the cluster as it is."""
        self.client.close()

    def outcomes(self, work, context, tasks, again=None):
        """Yields the Outcome of every task.

        Raises DeviceError when every worker's device fails, FileError when the scheduler is gone or
        no worker has come for long.
        """
        try:
            yield from self.crew.outcomes(ClusterJob(work, context), TaskQueue(tasks), again)
        except _lost() as error:
            raise FileError(
                f"the scheduler {self.address} no longer answers ({reason_of(error)}); what is "
                "finished stays: --resume goes on"
            ) from error
        finally:
            self.crew.release_all()


def _lost():
    """Errors that a client raises whose scheduler is gone."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    return CommClosedError, ConnectionError, TimeoutError, CancelledError


def _version():
    """Of this package on a worker."""
    return __version__
