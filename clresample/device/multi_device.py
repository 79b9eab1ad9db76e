"""Threads of the host beside a device, and work distributed to a process for each device.

Each device has its own process, because several OpenCL drivers in one process disturb each other.

Processes are started by "spawn": a script that calls this must put its own statements under
`if __name__ == "__main__":`, as for Python's multiprocessing.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
import traceback
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import connection

from threadpoolctl import threadpool_limits

from .device import Device, get_device
from .device_cache import DeviceWarning
from .discovery import DeviceError, choose, find_devices, n_host_cores
from .kernel_profiler import report

# Items of a device's first portion, before its speed is known.
FIRST_BATCH = 4
# Fraction of the remaining items that is dealt out at once, to all devices together: the rest evens
# out devices that turn out slower or faster.
BATCH_FRACTION = 0.5
# [s] Time for an interrupted process to return its results.
INTERRUPT_TIMEOUT_S = 60.0
# Largest number of host threads, each with its own intermediate arrays. More were not tried.
MAX_THREADS = 4


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


def distribute(function, items, devices, *, done, most):
    """Distributes `items` to several devices; returns the results in the items' order.

    function(items, device=) -> [result, ...]: picklable, as are items and results
    devices: choices in the forms of `get_device`, at least one; one named twice gets two processes
    done: called with the number of items done, after each portion
    most: items of a portion at most
    returns a list of results; None for an item that was not computed because of Ctrl-C
    Portions are sized by measured speed. If a device cannot be opened, or its process dies or
    raises, a DeviceWarning names it and its portion goes to the others.
    Raises ValueError without devices; DeviceError if nothing fits a choice, or all devices failed.
    """
    if not devices:
        raise ValueError("device is an empty list, must name at least one")
    table = _WorkQueue(items, most)
    workers = [_DeviceProcess(function, choice) for choice in devices]
    faults: list[str] = []
    try:
        while table.open:
            for worker in workers:
                if not worker.portion:
                    portion = table.take(worker, workers)
                    worker.give(portion, [table.items[i] for i in portion])
            if not workers:
                raise DeviceError("; ".join(faults))
            ready = connection.wait([w.pipe for w in workers if w.portion])
            for worker in [w for w in workers if w.pipe in ready]:
                fault = worker.collect(table)
                if fault:
                    faults.append(fault)
                    table.waiting += worker.portion
                    workers.remove(worker)
                    worker.stop()
                    if workers:
                        left = ", ".join(w.name for w in workers)
                        warnings.warn(f"{fault}; {left} goes on", DeviceWarning, stacklevel=3)
            done(table.n_done)
    except KeyboardInterrupt:
        for worker in workers:
            worker.interrupt()
        for worker in workers:
            worker.collect(table, patience_s=INTERRUPT_TIMEOUT_S)
    finally:
        for worker in workers:
            worker.stop()
    return table.results


class _WorkQueue:
    """Waiting items and finished results.

    waiting: indices of items; open: whether any item is not done
    """

    def __init__(self, items, most):
        self.items, self.most, self.waiting = items, most, list(range(len(items)))
        self.results, self.n_done = [None] * len(items), 0

    @property
    def open(self):
        return self.n_done < len(self.items)

    def take(self, worker, workers):
        """The next portion for a worker, [index, ...], by its fraction of the total speed."""
        if worker.speed:
            known = [w.speed for w in workers if w.speed]
            total = sum(known) + worker.speed * (len(workers) - len(known))
            n = max(1, int(BATCH_FRACTION * len(self.waiting) * worker.speed / total))
        else:
            n = min(FIRST_BATCH, -(-len(self.waiting) // len(workers)))
        n = min(n, self.most)
        portion, self.waiting = self.waiting[:n], self.waiting[n:]
        return portion


class _DeviceProcess:
    """A process with one device.

    portion: indices of its items; speed [items/s]: of its last portion, None before that
    """

    def __init__(self, function, choice):
        self.name, index = _named(choice)
        self.portion, self.speed = [], None
        spawn = multiprocessing.get_context("spawn")
        self.pipe, other = spawn.Pipe()
        self.process = spawn.Process(target=_work, args=(function, index, other), daemon=True)
        self.process.start()
        other.close()

    def give(self, portion, items):
        """Sends a portion, if there is one; a dead process is detected by `collect`."""
        self.portion, self._began = portion, time.perf_counter()
        if portion:
            with suppress(OSError):
                self.pipe.send(items)

    def collect(self, table, patience_s=None):
        """Receives the process's answer; returns a fault, or None."""
        if not self.portion:
            return None
        try:
            if patience_s is not None and not self.pipe.poll(patience_s):
                return f"{self.name} does not answer"
            results, fault = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(1)
            return f"the process of {self.name} ended with status {self.process.exitcode}"
        if fault:
            return f"{self.name} failed: {fault}"
        for i, result in zip(self.portion, results, strict=True):
            table.results[i] = result
        table.n_done += len(self.portion)
        self.speed = len(self.portion) / max(time.perf_counter() - self._began, 1e-6)
        self.portion = []
        return None

    def interrupt(self):
        self.process.terminate()

    def stop(self):
        self.pipe.close()
        self.process.join(1)
        if self.process.is_alive():
            self.process.kill()


def _named(choice):
    """A device's name and its index among all, valid in another process too."""
    cl_device = choice.cl if isinstance(choice, Device) else choose(choice)
    return cl_device.name.strip(), find_devices().index(cl_device)


def _work(function, index, pipe):
    """Runs in a process: items in, results out, until the queue is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C: the parent decides, and terminates

    def interrupt(*_):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            items = pipe.recv()
            try:
                answer = function(items, device=get_device(index)), None
            except Exception as error:
                what = traceback.format_exception_only(error)[-1].strip()
                answer = None, what
            pipe.send(answer)
    report()
    os._exit(0)  # skips the exit handlers of drivers, some of which wait for ever
