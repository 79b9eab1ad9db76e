"""One OpenCL device: its memory, kernels, copies and launches.

Every wait is a wait for an event, although blocking copies and clFinish exist. Mesa's rusticl 22.3
ends these too early if another thread that is about to wait for an event has just flushed the
commands. In three threads 15 of 24,000 blocking copies were incomplete when they returned. Waits
for events were always correct; each costs 2 us.

pyopencl is imported only when a device is first requested.
"""

from __future__ import annotations

import functools
import gc
import inspect
import math
import os
import threading
import warnings
import weakref
from itertools import accumulate

import numpy as np

from . import selftest
from .compiling import compile_beside
from .device_cache import DeviceCache, DeviceWarning
from .discovery import (
    DeviceError,
    builds_fp64,
    by_preference,
    choose,
    find_devices,
    is_default_choice,
    is_simulated,
    kind_of,
    load_pyopencl,
    warn_hidden_gpus,
)
from .errors import OUT_OF_MEMORY_STATUS, allocation_error, fork_error, status_of, to_device_error
from .kernel_profiler import start_profiling
from .program import Launcher, Programs
from .resident import ResidentImages

__all__ = ["Device", "get_device"]

# [bytes] Memory is zeroed in pieces of this size: NVIDIA and AMD mishandle fills of 2 GiB and more.
FILL_BYTES = 1 << 30


@functools.cache
def _makes_arrays_unchecked():
    """True if pyopencl makes arrays as its own results: checks of shapes take ten times as long."""
    import pyopencl.array

    needed = {"_fast", "_size", "_context", "_queue"}  # not in its documentation
    return needed <= set(inspect.signature(pyopencl.array.Array).parameters)


class Device:
    """An OpenCL device with one context and one in-order queue; `get_device` makes it.

    context, queue, cl: pyopencl's Context, CommandQueue and Device
    name, platform, kind: what the driver calls it; kind is "GPU", "CPU", "ACCELERATOR" or "OTHER"
    simulated: True for simulators and software drivers, see `is_simulated`
    compute_units: their number
    memory, max_alloc, in_use [bytes]: total, largest buffer, total of the arrays made here
    remembered: measurements of this device by earlier runs
    resident: ResidentImages
    profile: times of all launches if CLRESAMPLE_PROFILE was set, else None
    """

    def __init__(self, cl_device):
        cl = load_pyopencl()
        self.cl, self.name = cl_device, cl_device.name.strip()
        self.platform = cl_device.platform.name.strip()
        self.kind, self.simulated = kind_of(cl_device), is_simulated(cl_device)
        self.compute_units = cl_device.max_compute_units
        self.memory = cl_device.global_mem_size
        self.max_alloc = cl_device.max_mem_alloc_size
        self.in_use, self.remembered = 0, DeviceCache(cl_device)
        self.resident = ResidentImages(self)
        _opened[self] = os.getpid()
        self._enqueue, self._error = cl.enqueue_nd_range_kernel, cl.Error
        self._programs, self._lock = Programs(self), threading.Lock()
        self.context = self._call(cl.Context, [cl_device])
        self.profile = start_profiling(self.name)
        timed = cl.command_queue_properties.PROFILING_ENABLE if self.profile else 0
        self.queue = self._call(cl.CommandQueue, self.context, cl_device, properties=timed)

    def __repr__(self):
        return f"Device({self.platform}: {self.name})"

    def __reduce__(self):
        """Copies are the same object; pickles give the device of the same platform and name."""
        return get_device, (f"{self.platform}:{self.name}",)

    @functools.cached_property
    def has_fp64(self):
        """True if a kernel in double precision builds."""
        return builds_fp64(self.context)

    def empty(self, shape, dtype):
        """A pyopencl array (shape) with undefined values. Raises DeviceError if it does not fit."""
        import pyopencl.array

        dtype = np.dtype(dtype)
        # Python's own integers: a size past 2^63 must be refused, not wrapped.
        shape = (int(shape),) if np.ndim(shape) == 0 else tuple(map(int, shape))
        n_bytes = math.prod(shape, start=dtype.itemsize)
        if n_bytes > self.memory:
            raise allocation_error(self, n_bytes)
        steps = accumulate(shape[:0:-1], lambda step, n: step * max(n, 1), initial=dtype.itemsize)
        given = {"strides": tuple(steps)[::-1][: len(shape)], "allocator": self._allocate}
        if not _makes_arrays_unchecked():
            return self._call(pyopencl.array.Array, self.queue, shape, dtype, **given)
        given |= {"_size": n_bytes // dtype.itemsize, "_context": self.context}
        given |= {"_queue": self.queue, "_fast": True}
        return self._call(pyopencl.array.Array, None, shape, dtype, **given)

    def zeros(self, shape, dtype):
        """A pyopencl array (shape) of zeros. Raises DeviceError if it does not fit."""
        import pyopencl as cl

        array = self.empty(shape, dtype)
        for start in range(0, array.nbytes, FILL_BYTES):
            n_bytes = min(FILL_BYTES, array.nbytes - start)
            self._call(cl.enqueue_fill_buffer, self.queue, array.base_data, b"\0", start, n_bytes)
        return array

    def put(self, values, dtype=None):
        """A C-contiguous copy of a NumPy array on the device, native byte order, cast to dtype."""
        values = np.asarray(values)
        dtype = (values.dtype if dtype is None else np.dtype(dtype)).newbyteorder("=")
        values = np.asarray(values, dtype=dtype, order="C")
        array = self.empty(values.shape, dtype)
        if values.size:
            self.upload(values, array)
        return array

    def upload(self, values, array, *, wait=True):
        """Overwrites a device array with a C-contiguous NumPy array of its size and dtype.

        wait: if False, the copy is queued and its event returned. The event owns the values: keep
            it up to the next wait, because deleting it waits for the copy
        """
        return _copy(self, array.base_data, values, wait=wait, dst_offset=array.offset)

    def download(self, array, values):
        """Overwrites a C-contiguous NumPy array with a device array, after all queued work."""
        _copy(self, values, array.base_data, src_offset=array.offset)

    def copy(self, source, target):
        """Overwrites a device array with another of its size and dtype."""
        places = {"src_offset": source.offset, "dst_offset": target.offset}
        _copy(self, target.base_data, source.base_data, byte_count=source.nbytes, **places)

    def get(self, array):
        """The values of a pyopencl array as a NumPy array, after all queued work."""
        values = np.empty(array.shape, array.dtype)
        if values.size:
            self.download(array, values)
        return values

    def get_all(self, arrays):
        """The values of some arrays, as `get` gives them, with one wait for all."""
        found = [np.empty(array.shape, array.dtype) for array in arrays]
        pairs = [(v, array) for v, array in zip(found, arrays, strict=True) if v.size]
        events = []  # each keeps its target; the last one ends after the others
        for i, (values, array) in enumerate(pairs, 1):
            places = {"src_offset": array.offset, "wait": i == len(pairs)}
            events.append(_copy(self, values, array.base_data, **places))
        return found

    def get_parts(self, array, parts):
        """The values of a flat array in some parts; elsewhere they are undefined. One wait for all.

        parts (n, 2): first and one-past-last elements of each
        """
        values, events, size = np.empty(array.shape, array.dtype), [], array.dtype.itemsize
        parts = [(first, end) for first, end in joined(parts) if end > first]
        for i, (first, end) in enumerate(parts, 1):
            places = {"src_offset": array.offset + first * size, "wait": i == len(parts)}
            events.append(_copy(self, values[first:end], array.base_data, **places))
        return values

    def put_parts(self, parts, array):
        """Overwrites parts of a flat array, {first element: values}, with one wait for all."""
        events, size = [], array.dtype.itemsize
        parts = {first: values for first, values in parts.items() if len(values)}
        for i, (first, values) in enumerate(parts.items(), 1):
            places = {"dst_offset": array.offset + first * size, "wait": i == len(parts)}
            values = np.ascontiguousarray(values, array.dtype)
            events.append(_copy(self, array.base_data, values, **places))

    def launcher(self, file, name, *, dtype=np.float32, local_size=None, **defines):
        """A Launcher of kernel `name` in kernels/`file`, no argument bound yet.

        dtype: float32 or float64, which REAL stands for
        local_size: work-items of a group along each axis; None leaves it to the driver
        defines: macros; True defines the bare name, False and None leave it out
        Raises DeviceError, with the compiler's log, if the file does not build on the device, or
        without float64.
        """
        kernel, is_buffer = self._programs.kernel(file, name, dtype, defines)
        return Launcher(self, kernel, is_buffer, self._lock, local_size)

    def build_ahead(self, requests):
        """Starts building programs, (file, dtype, {macro: value}) each, in a thread."""
        self._programs.build_ahead(requests)

    def launch(self, kernel, global_size, local_size=None):
        """Queues a kernel whose arguments are set; sizes (x, y, z) as OpenCL counts them."""
        arguments = self._enqueue, self.queue, kernel, global_size, local_size
        program = self._programs.unlaunched(kernel)
        if program is None:
            return self._call(*arguments)
        with self._programs.compiling(program):
            event = self._call(*arguments)
            self.finish()
        return event

    def repeat(self, steps):
        """Queues the steps of a LaunchList once more.

        They are (kernel, arguments, global and local size), or (None, function, arguments, None).
        """

        def queue_all():
            enqueue, queue, lock = self._enqueue, self.queue, self._lock
            for kernel, values, global_size, local_size in steps:
                if kernel is None:
                    values(*global_size)
                    continue
                with lock:
                    kernel.set_args(*values)
                    enqueue(queue, kernel, global_size, local_size)

        self._call(queue_all)

    def finish(self, queue=None):
        """Waits until all queued work is done, here or in another in-order queue."""
        import pyopencl as cl

        self._call(self._call(cl.enqueue_marker, queue or self.queue).wait)

    def _call(self, function, *arguments, **options):
        """Calls a function of pyopencl; an error that a user can meet becomes a DeviceError."""
        try:
            return function(*arguments, **options)
        except self._error as error:
            meant = to_device_error(self, error)
            if meant is None:
                raise
            raise meant from error

    def _allocate(self, n_bytes):
        # Some CPU runtimes allocate more memory than exists, and the process dies when it is
        # written: the bytes of all live buffers are counted here.
        import pyopencl as cl

        if self.in_use + n_bytes > self.memory:
            gc.collect()  # arrays in reference cycles are still counted
        if n_bytes > min(self.max_alloc, self.memory - self.in_use):
            raise allocation_error(self, n_bytes)
        try:
            buffer = _buffer_type()(self.context, cl.mem_flags.READ_WRITE, n_bytes)
        except self._error as error:
            if status_of(error) in OUT_OF_MEMORY_STATUS:
                raise allocation_error(self, n_bytes) from error
            raise
        self.in_use += n_bytes
        weakref.finalize(buffer, self._freed, n_bytes).atexit = False
        return buffer

    def _freed(self, n_bytes):
        self.in_use -= n_bytes


def joined(parts):
    """Parts (first, end) of a line, those that touch as one, in their order."""
    found: list[tuple[int, int]] = []
    for first, end in np.asarray(parts).reshape(-1, 2).tolist():
        if found and found[-1][1] == first:
            first = found.pop()[0]
        found.append((first, end))
    return found


def _copy(device, target, source, *, wait=True, **options):
    """Queues a copy and returns its event; one from or to the host has finished by then.

    wait: False leaves out the wait for the host's
    """
    import pyopencl as cl

    if isinstance(target, np.ndarray) or isinstance(source, np.ndarray):
        options["is_blocking"] = wait
    event = device._call(cl.enqueue_copy, device.queue, target, source, **options)
    if options.get("is_blocking"):
        device._call(event.wait)
    return event


@functools.cache
def _buffer_type():
    class Buffer(load_pyopencl().Buffer):
        """A buffer that permits weak references, which pyopencl's own class does not."""

    return Buffer


def get_device(choice=None) -> Device:
    """The chosen device; repeated calls return the same object.

    choice: None, a Device, an index, "platform:device" (each an index or part of a name), or part
        of a device's or platform's name. None reads CLRESAMPLE_DEVICE (the same forms), then
        PYOPENCL_CTX (pyopencl's form), and then takes the first GPU, or else the first CPU;
        simulators come last. CLRESAMPLE_ICD names a driver library to look for devices in.
    At its first use a device renders a small image, which is compared with NumPy's. If the test
    fails and no device was named, the next device is used, with a DeviceWarning. One is also issued
    if a CPU is used beside a GPU whose driver lies where the OpenCL loader does not look.
    Raises DeviceError if there is no platform, if nothing matches the choice, or if the device
    that was chosen fails that test.
    """
    if isinstance(choice, Device):
        return _of_this_process(choice)
    candidates = by_preference(find_devices()) if is_default_choice(choice) else [choose(choice)]
    faults: list[str] = []
    for candidate in candidates:
        fault = _fault(candidate)
        if fault is None:
            for message in faults:
                warnings.warn(f"{message}; {candidate.name} is used", DeviceWarning, stacklevel=2)
            if is_default_choice(choice) and kind_of(candidate) != "GPU":
                warn_hidden_gpus()
            return _of_this_process(_open(candidate))
        faults.append(fault)
    raise DeviceError(
        "; ".join(faults) + ": update the driver, or choose another device (`clresample devices` "
        "lists them)"
    )


# The process that opened each device.
_opened: weakref.WeakKeyDictionary[Device, int] = weakref.WeakKeyDictionary()


def _of_this_process(device):
    """The device. Raises DeviceError in a process that was forked after the device was opened."""
    if os.getpid() != _opened[device]:
        raise fork_error(device)
    return device


def _refuse_in_child():
    """Makes every use of an open device raise in forked processes, at no cost to the parent.

    The threads of a driver do not exist in a forked process, so that a call would wait for ever.
    """

    def refuse(device):
        raise fork_error(device)

    for device in _opened:
        device._call = lambda *_, device=device, **__: refuse(device)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_refuse_in_child)


@functools.cache
def _open(cl_device):
    return Device(cl_device)


@functools.cache
def _fault(cl_device):
    """Reason not to use a pyopencl device, or None."""
    try:
        device = _open(cl_device)
        if not selftest.has_passed(device.remembered):
            compile_beside(device)
        return selftest.self_test_fault(device, device.remembered)
    except (DeviceError, load_pyopencl().Error) as error:
        return f"{cl_device.name.strip()} fails its self-test: {error}"
