"""Errors of devices in readable words: the device, the fault, the remedy."""

from __future__ import annotations

from .discovery import DeviceError, DeviceLostError, format_size, load_pyopencl
from .drivers import pocl_cache_fault

# Status codes after which the device or its queue no longer answers.
# -9999 is NVIDIA's own code for an illegal access, after which its context is dead.
LOST_STATUS = {
    "DEVICE_NOT_AVAILABLE",
    "OUT_OF_RESOURCES",
    "INVALID_COMMAND_QUEUE",
    "INVALID_CONTEXT",
    "INVALID_DEVICE",
    "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST",
    "-9999",
}
# Status codes of a device without memory for a buffer.
OUT_OF_MEMORY_STATUS = {
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "INVALID_BUFFER_SIZE",
    "OUT_OF_HOST_MEMORY",
}


def status_of(error):
    """The name of a pyopencl error's status, or its number where it has none."""
    code = getattr(error, "code", None)
    names = vars(load_pyopencl().status_code)
    return next((n for n, c in names.items() if n.isupper() and c == code), str(code))


def to_device_error(device, error):
    """A DeviceError for a pyopencl error that a user can meet; None for a bug of clresample."""
    status = status_of(error)
    if status in OUT_OF_MEMORY_STATUS:
        return DeviceError(
            f"{device.name} is out of memory ({status}; it has {format_size(device.memory)}): use "
            "smaller batches or tiles, or free other arrays"
        )
    if status in LOST_STATUS:
        return DeviceLostError(
            f"{device.name} ({device.platform}) no longer answers ({status}): start again, look "
            "at the driver's log for a reset or a time limit on kernels, use smaller "
            "batches, or choose another device with CLRESAMPLE_DEVICE"
        )
    return None


def allocation_error(device, n_bytes):
    """A DeviceError for an array of `n_bytes` that does not fit."""
    return DeviceError(
        f"an array needs {format_size(n_bytes)}; {device.name} has {format_size(device.memory)}, "
        f"{format_size(device.in_use)} of it in use, and takes {format_size(device.max_alloc)} in "
        "one buffer: use smaller batches or tiles, or free other arrays"
    )


def fork_error(device):
    """A DeviceError for a device that was opened before this process was forked."""
    return DeviceError(
        f"{device.name} was opened before this process was forked, and cannot answer here: start "
        'processes with multiprocessing.get_context("spawn"), or fork before a device is used'
    )


def float64_error(device):
    """A DeviceError for float64 on a device without it."""
    return DeviceError(
        f"{device.name} has no double precision: use float32, or another device "
        "(`clresample devices` lists them)"
    )


def build_error(device, file, defines, log):
    """A DeviceError for a kernel file that does not compile; log: the compiler's own words."""
    if "Portable Computing" in device.platform and (cause := pocl_cache_fault()):
        return DeviceError(f"{file} does not build: {cause}")
    return DeviceError(
        f"{file} does not build on {device.name} ({device.platform}) with "
        f"{defines}; the compiler says:\n{log}\n"
        "Update the driver, or choose another device with CLRESAMPLE_DEVICE "
        "(`clresample devices` lists them)"
    )
