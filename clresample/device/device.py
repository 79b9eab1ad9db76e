"""One OpenCL device: its choice, its memory, its kernels, and readable errors.

pyopencl is imported when a device is first asked for, never before.
"""

from __future__ import annotations

import functools
import gc
import math
import weakref

import numpy as np

from .discovery import DeviceError, builds_fp64, choose, format_size, kind_of, load_pyopencl
from .launcher import Launcher, signature
from .program import build_log, define_line, read_kernel

__all__ = ["Device", "get_device"]

# NVIDIA and AMD mishandle fills of 2 GiB and more: zero memory in pieces [bytes].
FILL_BYTES = 1 << 30
# Status codes after which the device or its queue no longer answers.
# -9999 is NVIDIA's own code for an illegal access, after which its context is dead.
LOST = {
    "DEVICE_NOT_AVAILABLE",
    "OUT_OF_RESOURCES",
    "INVALID_COMMAND_QUEUE",
    "INVALID_CONTEXT",
    "INVALID_DEVICE",
    "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST",
    "-9999",
}
FULL = {"MEM_OBJECT_ALLOCATION_FAILURE", "INVALID_BUFFER_SIZE", "OUT_OF_HOST_MEMORY"}


class Device:
    """An OpenCL device with one context and one in-order queue; `get_device` makes it.

    context, queue, cl: pyopencl's Context, CommandQueue and Device
    name, platform, kind: what the driver calls it; kind is "GPU", "CPU", "ACCELERATOR" or "OTHER"
    compute_units, max_group: counts
    memory, max_alloc, in_use [bytes]: all of it, the largest buffer, what arrays made here hold
    """

    def __init__(self, cl_device):
        cl = load_pyopencl()
        self.cl = cl_device
        self.name = cl_device.name.strip()
        self.platform = cl_device.platform.name.strip()
        self.kind = kind_of(cl_device)
        self.compute_units = cl_device.max_compute_units
        self.memory = cl_device.global_mem_size
        self.max_alloc = cl_device.max_mem_alloc_size
        self.max_group = cl_device.max_work_group_size
        self.in_use = 0
        self._enqueue = cl.enqueue_nd_range_kernel
        self._error = cl.Error
        self._programs = {}
        self.context = self._call(cl.Context, [cl_device])
        self.queue = self._call(cl.CommandQueue, self.context, cl_device)

    def __repr__(self):
        return f"Device({self.platform}: {self.name})"

    @functools.cached_property
    def has_fp64(self):
        """True where a kernel in double precision builds."""
        return builds_fp64(self.context)

    def empty(self, shape, dtype):
        """A pyopencl array (shape) with undefined values; DeviceError where it cannot fit."""
        import pyopencl.array

        dtype = np.dtype(dtype)
        # Python's own integers: a size past 2^63 must be refused, not wrapped.
        shape = (int(shape),) if np.ndim(shape) == 0 else tuple(map(int, shape))
        n_bytes = math.prod(shape, start=dtype.itemsize)
        if n_bytes > self.memory:
            raise self._too_large(n_bytes)
        return self._call(pyopencl.array.Array, self.queue, shape, dtype, allocator=self._allocate)

    def zeros(self, shape, dtype):
        """A pyopencl array (shape) of zeros; DeviceError where it cannot fit."""
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

    def upload(self, values, array):
        """Overwrite a device array with a C-contiguous NumPy array of its size and dtype."""
        self._copy(array.base_data, values, dst_offset=array.offset)

    def download(self, array, values):
        """Overwrite a C-contiguous NumPy array with a device array, once all queued is done."""
        self._copy(values, array.base_data, src_offset=array.offset)

    def copy(self, source, target):
        """Overwrite a device array with another of its size and dtype."""
        self._copy(
            target.base_data,
            source.base_data,
            byte_count=source.nbytes,
            src_offset=source.offset,
            dst_offset=target.offset,
        )

    def _copy(self, target, source, **options):
        import pyopencl as cl

        self._call(cl.enqueue_copy, self.queue, target, source, **options)

    def get(self, array):
        """The values of a pyopencl array as a NumPy array, once all that was queued is done."""
        return self._call(array.get, self.queue)

    def kernel(self, file, name, *, dtype=np.float32, **defines):
        """A fresh pyopencl.Kernel `name` from kernels/`file`; equal requests share one program.

        defines: macros; True defines the bare name, False and None leave it out
        DeviceError: the file does not build here (with the compiler's log), or no float64
        """
        import pyopencl as cl

        dtype = np.dtype(dtype)
        if dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise ValueError(f"dtype is {dtype}; kernels are built for float32 or float64")
        key = (file, dtype, tuple(sorted(defines.items())))
        if key not in self._programs:
            self._programs[key] = self._build(file, dtype, defines)
        return cl.Kernel(self._programs[key], name)

    def launcher(self, file, name, *, dtype=np.float32, local_size=None, **defines):
        """A Launcher of `kernel(file, name, ...)`, whose arguments go by their names."""
        kernel = self.kernel(file, name, dtype=dtype, **defines)
        return Launcher(self, kernel, signature(file, name), dtype, local_size)

    def launch(self, kernel, global_size, local_size=None):
        """Queue a kernel whose arguments are set; sizes (x, y, z) as OpenCL counts them."""
        return self._call(self._enqueue, self.queue, kernel, global_size, local_size)

    def finish(self):
        """Wait until everything queued is done."""
        self._call(self.queue.finish)

    def _call(self, function, *arguments, **options):
        """What a function of pyopencl returns; an error that a user can meet made readable."""
        try:
            return function(*arguments, **options)
        except self._error as error:
            message = self._explain(_status(error))
            if message is None:  # a mistake of our own stays as it is
                raise
            raise DeviceError(message) from error

    def _build(self, file, dtype, defines):
        import pyopencl as cl

        if dtype == np.float64:
            if not self.has_fp64:
                raise DeviceError(
                    f"{self.name} has no double precision: use float32, or another device "
                    "(`clresample devices` lists them)"
                )
            defines = {**defines, "REAL": "double", "USE_DOUBLE": True}
        else:
            defines = {**defines, "REAL": "float"}
        lines = [define_line(key, value) for key, value in defines.items()]
        source = "\n".join([*filter(None, lines), f'#line 1 "{file}"', read_kernel(file)])
        program = cl.Program(self.context, source)
        try:
            return program.build(options=["-cl-std=CL1.2"])
        except cl.Error as error:
            raise DeviceError(
                f"{file} does not build on {self.name} ({self.platform}) with "
                f"{defines}; the compiler says:\n{build_log(error)}\n"
                "Update the driver, or choose another device with CLRESAMPLE_DEVICE "
                "(`clresample devices` lists them)"
            ) from error

    def _allocate(self, n_bytes):
        # Some CPU runtimes promise more memory than there is, and the process dies on writing it:
        # count what is in use, each buffer until it is gone.
        import pyopencl as cl

        if self.in_use + n_bytes > self.memory:
            gc.collect()  # arrays in reference cycles are still counted
        if n_bytes > min(self.max_alloc, self.memory - self.in_use):
            raise self._too_large(n_bytes)
        try:
            buffer = _buffer_type()(self.context, cl.mem_flags.READ_WRITE, n_bytes)
        except self._error as error:
            if _status(error) in FULL:
                raise self._too_large(n_bytes) from error
            raise
        self.in_use += n_bytes
        weakref.finalize(buffer, self._freed, n_bytes).atexit = False
        return buffer

    def _freed(self, n_bytes):
        self.in_use -= n_bytes

    def _too_large(self, n_bytes):
        return DeviceError(
            f"an array needs {format_size(n_bytes)}; {self.name} has {format_size(self.memory)}, "
            f"{format_size(self.in_use)} of it in use, and takes {format_size(self.max_alloc)} in "
            "one buffer: use smaller batches or tiles, or free other arrays"
        )

    def _explain(self, status):
        if status in FULL:
            return (
                f"{self.name} is out of memory ({status}; it has {format_size(self.memory)}): use "
                "smaller batches or tiles, or free other arrays"
            )
        if status in LOST:
            return (
                f"{self.name} ({self.platform}) no longer answers ({status}): start again, look "
                "at the driver's log for a reset or a time limit on kernels, use smaller "
                "batches, or choose another device with CLRESAMPLE_DEVICE"
            )
        return None


@functools.cache
def _buffer_type():
    class Buffer(load_pyopencl().Buffer):
        """pyopencl's own cannot be watched by a weak reference; a Python class can."""

    return Buffer


def get_device(choice=None):
    """The chosen device; asked twice it is the same object.

    choice: None, a Device, an index, "platform:device" (each an index or part of a name), or part
        of a device's or platform's name. None reads CLRESAMPLE_DEVICE (the same forms), then
        PYOPENCL_CTX (pyopencl's form), and then takes the first GPU, or else the first CPU.
    DeviceError: there is no platform, or nothing fits the choice
    """
    return choice if isinstance(choice, Device) else _open(choose(choice))


@functools.cache
def _open(cl_device):
    return Device(cl_device)


def _status(error):
    """The name of an OpenCL error's status, or its number where it has none."""
    code = getattr(error, "code", None)
    names = vars(load_pyopencl().status_code)
    return next((n for n, c in names.items() if n.isupper() and c == code), str(code))
