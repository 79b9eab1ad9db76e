"""Lists OpenCL devices and selects one by a user's choice such as "GPU" or "0:1".

pyopencl is imported only when devices are first listed.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from .device_cache import DeviceWarning, system_caches
from .drivers import (
    address_space_warning,
    driver_advice,
    driver_fault,
    is_registered,
    named_library,
    pocl_cache_fault,
    register_named_library,
    undetected_drivers,
    warn_named_library,
    write_fault,
)
from .pocl_cpu_name import set_pocl_cpu_name

# Order of preference when nothing is chosen; a kind that is not listed comes last.
DEVICE_KINDS = ("GPU", "CPU", "ACCELERATOR")
# Parts of the names of simulators and of software drivers that run on the CPU. These devices come
# last in the choice, whatever kind they report.
SIMULATED = ("oclgrind", "simulator", "emulat", "llvmpipe", "softpipe", "swiftshader")
HIDDEN_GPU = "no GPU is used"  # begins the warning of `warn_hidden_gpus`
# Compiles only where double is a type of 8 bytes, whatever the driver claims.
FP64_PROBE = """
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef char proof[sizeof(double) == 8 ? 1 : -1];
__kernel void probe(__global double *x) { x[0] = x[0] / 3.0; }
"""


class DeviceError(RuntimeError):
    """A failed device operation; the message gives the reason and the remedy."""


class DeviceLostError(DeviceError):
    """A device that no longer answers, with all of its memory."""


@dataclass(frozen=True)
class DeviceInfo:
    """One row of the table of devices; sizes in bytes, `fp64` None if it could not be tested."""

    index: int
    platform: str
    name: str
    kind: str
    version: str
    compute_units: int
    memory: int
    max_alloc: int
    fp64: bool | None
    chosen: bool


def list_devices(choice=None):
    """Every OpenCL device as a DeviceInfo; `chosen` marks the one of `get_device(choice)`."""
    found = find_devices()
    try:
        chosen = choose(choice)
    except DeviceError:  # nothing fits the choice: the table is what helps then
        chosen = None
    return [
        DeviceInfo(
            index=i_device,
            platform=device.platform.name.strip(),
            name=device.name.strip(),
            kind=kind_of(device),
            version=" ".join(device.version.split()[:2]),  # "OpenCL 3.0 vendor text"
            compute_units=device.max_compute_units,
            memory=device.global_mem_size,
            max_alloc=device.max_mem_alloc_size,
            fp64=_try_fp64(device),
            chosen=device == chosen,
        )
        for i_device, device in enumerate(found)
    ]


def format_size(n_bytes):
    """A number of bytes with a unit: 3.5 GiB, 512 MiB, 12 B."""
    for unit, power in (("GiB", 30), ("MiB", 20), ("KiB", 10)):
        if n_bytes >= 1 << power:
            return f"{n_bytes / (1 << power):.3g} {unit}"
    return f"{n_bytes} B"


def choose(choice):
    """The pyopencl device for a choice in the forms of `get_device`."""
    found = find_devices()
    if choice is not None:
        return _match(str(choice), found, "device")
    if os.environ.get("CLRESAMPLE_DEVICE"):
        return _match(os.environ["CLRESAMPLE_DEVICE"], found, "CLRESAMPLE_DEVICE")
    if os.environ.get("PYOPENCL_CTX"):
        return _match_pyopencl(os.environ["PYOPENCL_CTX"], found)
    return by_preference(found)[0]


def is_default_choice(choice):
    """True where neither the caller's choice nor the environment names a device."""
    return choice is None and not any(map(os.environ.get, ("CLRESAMPLE_DEVICE", "PYOPENCL_CTX")))


def _match(choice, found, source):
    """The preferred device among those that fit: index, then platform:device, then a name."""
    text = choice.strip().lower()
    if text.isdecimal():
        fits = found[int(text) : int(text) + 1]
    else:
        fits = _match_pair(*text.split(":", 1), found) if ":" in text else []
        # A name may hold a colon, as in "gfx906:xnack-", so names are tried last.
        fits = fits or [d for d in found if text and text in d.name.lower()]
        fits = fits or [d for d in found if text and text in d.platform.name.lower()]
    if not fits:
        raise _no_fit(source, choice, found)
    return by_preference(fits)[0]


def _match_pair(platform, device, found):
    platforms = list(dict.fromkeys(d.platform for d in found))
    if platform.isdecimal():
        platforms = platforms[int(platform) : int(platform) + 1]
    else:
        platforms = [p for p in platforms if platform in p.name.lower()]
    groups = [[d for d in found if d.platform == p] for p in platforms]
    if device.isdecimal():
        return [d for group in groups for d in group[int(device) : int(device) + 1]]
    return [d for group in groups for d in group if device in d.name.lower()]


def _match_pyopencl(choice, found):
    """The first device that pyopencl itself reads from PYOPENCL_CTX."""
    cl = load_pyopencl()
    try:
        return cl.choose_devices(interactive=False, answers=choice.split(":"))[0]
    except (RuntimeError, cl.Error) as error:
        raise _no_fit("PYOPENCL_CTX", choice, found) from error


def _no_fit(source, choice, found):
    names = "; ".join(f"{i} = {d.platform.name}: {d.name}" for i, d in enumerate(found))
    return DeviceError(f"{source} is {choice!r}, which fits no device; there are: {names}")


def by_preference(found):
    """Devices in order of preference, for use when nothing is chosen."""
    return sorted(found, key=_preference)


def _preference(device):
    kind = kind_of(device)
    place = DEVICE_KINDS.index(kind) if kind in DEVICE_KINDS else len(DEVICE_KINDS)
    return not device.available, is_simulated(device), place


def is_simulated(device):
    """True for a simulator or a software driver on the CPU, by its name."""
    names = f"{device.platform.name} {device.name}".lower()
    return any(name in names for name in SIMULATED)


def driver_hints(*, registered=True):
    """Lines on GPU drivers of this machine that provide no device, each with its remedy.

    registered: include those that the loader looks for
    """
    try:
        found = find_devices()
    except DeviceError:
        found = []
    if named_library():
        return []
    return [
        driver_advice(vendor, path, _addresses(found))
        for vendor, path in undetected_drivers(_served(found))
        if registered or not is_registered(path)
    ]


@functools.cache  # once
def warn_hidden_gpus():
    """Warns of GPU drivers that the loader does not look for, since a CPU is used instead."""
    if os.environ.get("OCL_ICD_VENDORS"):  # the user's own choice of drivers
        return
    with suppress(OSError, ValueError):  # files that cannot be read harm nobody
        for line in driver_hints(registered=False):
            warnings.warn(f"{HIDDEN_GPU}: {line}", DeviceWarning, stacklevel=3)


def _served(found):
    """Names of the platforms and devices that are real GPUs."""
    real = [d for d in found if kind_of(d) == "GPU" and not is_simulated(d)]
    return [f"{d.platform.name} {d.platform.vendor} {d.name}" for d in real]


def _addresses(found):
    """Of the platforms of devices, as `driver_fault` takes them."""
    return frozenset(device.platform.int_ptr for device in found)


def find_devices():
    """Every device of every platform, in the drivers' order; DeviceError where there is none.

    Issues a DeviceWarning if the library of CLRESAMPLE_ICD provides no device.
    """
    cl = load_pyopencl()
    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the loader reports this way that there are none
        platforms = []
    found = []
    for platform in platforms:
        try:
            found += platform.get_devices()
        except cl.Error:  # a driver without a device, such as a GPU's on a machine without one
            continue
    library = named_library()
    if found:
        for device in found:
            set_pocl_cpu_name(device)
        if library:
            warn_named_library(library, _addresses(found))
        return found
    if any("Portable Computing" in p.name for p in platforms) and (cause := pocl_cache_fault()):
        raise DeviceError(cause)
    what = "OpenCL platform" if not platforms else f"device on {platforms[0].name}"
    vendors = os.environ.get("OCL_ICD_VENDORS")
    if vendors and not Path(vendors).exists():
        way = (
            f"OCL_ICD_VENDORS names a missing folder, {vendors}, which hides every driver: unset it"
        )
    else:
        way = "install your GPU's OpenCL driver, or the CPU runtime: pip install 'pyopencl[pocl]'"
        if vendors:
            way += f"; OCL_ICD_VENDORS={vendors} limits the search to that place"
        if library:
            way += f"; CLRESAMPLE_ICD={library} {driver_fault(library, set())}"
        for vendor, path in undetected_drivers([]):
            way += f"; {driver_advice(vendor, path, set())}"
    raise DeviceError(f"no {what} found: {way}")


def load_pyopencl():
    if cause := address_space_warning():
        raise DeviceError(cause)
    if os.environ.get("POCL_CACHE_DIR") == "":
        del os.environ["POCL_CACHE_DIR"]  # an empty one ends the process in PoCL 3.1
    if "pyopencl" not in sys.modules and "PYOPENCL_NO_CACHE" not in os.environ:
        # pyopencl keeps some milliseconds' work there, and ends where it cannot
        kept = Path(os.environ.get("XDG_CACHE_HOME") or system_caches()) / "pytools"
        if write_fault(kept):
            os.environ["PYOPENCL_NO_CACHE"] = "1"
    try:
        import pyopencl
    except ImportError as error:
        raise DeviceError(
            f"pyopencl cannot be imported ({error}): pip install 'pyopencl[pocl]'"
        ) from error
    _ignore_remarks(pyopencl)
    try:
        register_named_library()
    except OSError as error:
        raise DeviceError(
            f"CLRESAMPLE_ICD names a driver library that is not there: {named_library()}"
        ) from error
    return pyopencl


@functools.cache
def _ignore_remarks(cl):
    """Filters pyopencl's warnings of compilers, such as Intel's, that comment on every build."""
    warnings.filterwarnings("ignore", category=cl.CompilerWarning)


def kind_of(device):
    types = load_pyopencl().device_type
    return next((kind for kind in DEVICE_KINDS if device.type & getattr(types, kind)), "OTHER")


def _try_fp64(device):
    cl = load_pyopencl()
    try:
        return builds_fp64(cl.Context([device]))
    except cl.Error:
        return None


def builds_fp64(context):
    cl = load_pyopencl()
    try:
        cl.Program(context, FP64_PROBE).build()
    except cl.Error:
        return False
    return True
