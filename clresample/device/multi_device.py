"""Threads of the host beside a device, and work distributed to a process for each device.

Each device has its own process, because several OpenCL drivers in one process disturb each other.

Processes are started by "spawn". Unless `imports_main` is False, a script that calls this must put
its own statements under `if __name__ == "__main__":`, as for Python's multiprocessing.
"""

from __future__ import annotations

import queue
import signal
import threading
import traceback
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

from threadpoolctl import threadpool_limits

from .device import Device, get_device
from .device_cache import DeviceWarning
from .discovery import (
    DeviceError,
    choose,
    find_devices,
    is_simulated,
    kind_of,
)
from .host import free_memory, n_host_cores
from .workers.crew import TaskQueue
from .workers.outcome import Cause, Reason
from .workers.pool import WorkerPool
from .workers.process_limits import thread_environment

# Items of a device's first portion, before its speed is known.
FIRST_BATCH = 4
# Fraction of the remaining items that is dealt out at once, to all devices together: the rest evens
# out devices that turn out slower or faster.
BATCH_FRACTION = 0.5
# [s] Time for an interrupted process to return its results.
INTERRUPT_TIMEOUT_S = 60.0
# Largest number of host threads, each with its own intermediate arrays. More were not tried.
MAX_THREADS = 4
# [bytes] Free memory for a process of fits: libraries, a group and its results.
PROCESS_MEMORY = 3 << 29


class _BlasThreadLimit:
    """Counts the callers that need linear algebra on one thread, and restores its threads."""

    lock = threading.Lock()
    n_callers = 0
    limits: threadpool_limits | None = None


@contextmanager
def one_blas_thread():
    """Context in which NumPy's and SciPy's linear algebra uses one thread of this process.

    BLAS threads spin while they wait for each other and for a CPU device. On the small matrices of
    a fit this takes 2.7 times the processor time on two cores, and 1.8 times as long. Callers in
    several threads share the context: the last one to leave restores the previous setting.
    """
    with _BlasThreadLimit.lock:
        if not _BlasThreadLimit.n_callers:
            _BlasThreadLimit.limits = threadpool_limits(1, user_api="blas")
        _BlasThreadLimit.n_callers += 1
    try:
        yield
    finally:
        with _BlasThreadLimit.lock:
            _BlasThreadLimit.n_callers -= 1
            if not _BlasThreadLimit.n_callers:
                _BlasThreadLimit.limits.restore_original_limits()


def host_threads(device):
    """Number of host threads to use beside a device.

    One for each core of this process, but no more than a CPU device has compute units, which are
    few if processes share the cores.
    """
    n_cores = n_host_cores()
    n_units = device.compute_units if device.kind == "CPU" else n_cores
    return min(n_cores, n_units, MAX_THREADS)


def n_beside(cl_device, memory=PROCESS_MEMORY) -> int:
    """Number of processes that a device does well to have side by side.

    One for each core of a CPU, as far as free memory suffices for this much [bytes] each; 1 for
    other devices, and at least.
    """
    if kind_of(cl_device) != "CPU" or is_simulated(cl_device):
        return 1
    n_cores = min(n_host_cores(), cl_device.max_compute_units)
    return max(1, min(n_cores, free_memory() // memory))


def map_threads(n_threads, function, items):
    """[function(item), ...] of items, in their order; see `iterate_threads`."""
    return list(iterate_threads(n_threads, function, items))


def iterate_threads(n_threads, function, items):
    """Yields function(item) of items, in their order, while others are computed in threads.

    For calls that spend their time in NumPy's loops over large arrays, for which other threads need
    not wait. Items that are not begun when the iterator is closed are left out.
    """
    items = list(items)
    if min(n_threads, len(items)) < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(min(n_threads, len(items))) as pool:
        yield from pool.map(function, items)


def prefetch(items):
    """Yields the items of an iterator, while a thread prepares the next one.

    Beside the item in use, at most one is ready and one in progress. An exception of the iterator
    is raised in the order of the items. If closed early, the thread ends with its current item.
    """
    ready: queue.Queue = queue.Queue(maxsize=1)
    stop = threading.Event()

    def hand_over(kind, value):
        while not stop.is_set():
            with suppress(queue.Full):
                ready.put((kind, value), timeout=0.1)
                return

    def make():
        try:
            for item in items:
                hand_over("item", item)
                if stop.is_set():
                    return
            hand_over("end", None)
        except BaseException as error:
            hand_over("error", error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    try:
        while True:
            kind, value = ready.get()
            if kind == "error":
                raise value
            if kind == "end":
                return
            yield value
            del value  # its memory is for the next
    finally:
        stop.set()
        thread.join()


def distribute(function, items, devices, *, done, most, equal=False, imports_main=True):
    """Distributes `items` to several devices; returns the results in the items' order.

    function(items, device=) -> [result, ...]: picklable, as are items and results
    devices: choices in the forms of `get_device`, at least one; one named twice gets two processes
    done: called with the number of items done, after each portion
    most: items of a portion at most
    equal: portions of `most` items each, so that results do not depend on the devices' speed
    imports_main: see `WorkerPool`
    returns a list of results; None for an item that was not computed because of Ctrl-C
    Other portions are sized by measured speed. If a device cannot be opened, or its process dies or
    raises, a DeviceWarning names it and its portion goes to the others.
    Raises ValueError without devices; DeviceError if nothing fits a choice, or all devices failed.
    """
    if not devices:
        raise ValueError("device is an empty list, must name at least one")
    portions = (_EqualPortions if equal else _Portions)(items, most)
    with _DevicePool([_named(choice) for choice in devices], imports_main) as pool:
        job = _compute, [(function, index) for _, index in pool.devices]
        try:
            for outcome in pool.outcomes(job, portions):
                portions.store(outcome)
                done(portions.n_done)
        except KeyboardInterrupt:
            for outcome in pool.interrupted(INTERRUPT_TIMEOUT_S):
                portions.store(outcome)
    return portions.results


class _Portions(TaskQueue):
    """Portions [(index, item), ...] of waiting items, and finished results.

    speeds {worker's number: items/s}: of its last portion; a worker without one is new
    """

    def __init__(self, items, most):
        super().__init__(enumerate(items))
        self.most, self.speeds = most, {}
        self.results, self.n_done = [None] * len(self), 0

    def take(self, worker, workers):
        """The next portion for a worker, by its fraction of the total speed."""
        speed = self.speeds.get(worker.number)
        if speed:
            known = [self.speeds[w.number] for w in workers if w.number in self.speeds]
            total = sum(known) + speed * (len(workers) - len(known))
            n = max(1, int(BATCH_FRACTION * len(self) * speed / total))
        else:
            n = min(FIRST_BATCH, -(-len(self) // len(workers)))
        return [self.waiting.popleft() for _ in range(min(n, self.most, len(self)))]

    def put_back(self, tasks):
        """Puts the items of portions after all others."""
        for portion in tasks:
            self.waiting.extend(portion)

    def store(self, outcome):
        """Stores the results of a portion that has ended."""
        for (i, _), result in zip(outcome.task, outcome.value, strict=True):
            self.results[i] = result
        self.n_done += len(outcome.task)
        seconds = max(outcome.end_s - outcome.start_s, 1e-6)
        self.speeds[outcome.worker] = len(outcome.task) / seconds


class _EqualPortions(_Portions):
    """Portions of `most` items each, in their order."""

    def take(self, worker, workers):
        """The next portion, for any worker."""
        return [self.waiting.popleft() for _ in range(min(self.most, len(self)))]


class _DevicePool(WorkerPool):
    """A process for each device, which is lost with its first failure.

    Processes of one CPU device share its threads: with all of them each, launches wait for threads
    that other processes' launches keep from running.

    devices: name and index of each; imports_main: see WorkerPool
    """

    FAULTS, MAX_FAULTS = (Cause.DEVICE, Cause.WORKER), 1

    def __init__(self, devices, imports_main=True):
        most = max(Counter(devices).values())  # processes that share a device
        given = {"environment": thread_environment(most), "setup": _interruptible}
        given["imports_main"] = imports_main
        super().__init__(len(devices), **given, reason_of=_failed)
        self.devices, self.faults = devices, []

    def drop(self, worker, reason):
        """Removes a device, with a warning if there are others, otherwise with a DeviceError."""
        super().drop(worker, reason)
        self.faults.append(f"{self.devices[worker.number][0]} failed: {reason}")
        if not self.workers:
            raise DeviceError("; ".join(self.faults))
        left = ", ".join(self.devices[w.number][0] for w in self.workers)
        # the caller's caller of `distribute`
        warnings.warn(f"{self.faults[-1]}; {left} goes on", DeviceWarning, stacklevel=6)


def _named(choice):
    """A device's name and its index among all, valid in another process too."""
    cl_device = choice.cl if isinstance(choice, Device) else choose(choice)
    return cl_device.name.strip(), find_devices().index(cl_device)


def _compute(given, portion):
    """Runs in a device's process: the results of a portion."""
    function, index = given
    return function([item for _, item in portion], device=get_device(index))


def _failed(error):
    """The Reason of an exception: whatever it is, the others continue."""
    return Reason(traceback.format_exception_only(error)[-1].strip(), Cause.DEVICE)


def _interruptible():
    """Makes SIGTERM raise KeyboardInterrupt, so that a portion's results can be returned."""

    def interrupt(*_):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
