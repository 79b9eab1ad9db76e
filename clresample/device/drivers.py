"""Finds driver libraries: that of CLRESAMPLE_ICD, and GPUs' that the OpenCL loader misses.

The loader (libOpenCL) learns of drivers from .icd files, each of which names a library. Containers
often have a GPU's library without its .icd file.
"""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
import weakref
from contextlib import suppress
from pathlib import Path

from .device_cache import DeviceWarning

# OpenCL drivers of GPUs, by their library.
LIBRARIES = {
    "libnvidia-opencl.so.1": "NVIDIA",
    "libamdocl64.so": "AMD",
    "libigdrcl.so": "Intel",
}
# Where drivers lie that the system's own list of libraries may not have: mounted into containers,
# or in folders of their own.
FOLDERS = (
    "/usr/local/nvidia/lib64",
    "/usr/local/nvidia/lib",
    "/usr/lib/wsl/lib",
    "/usr/lib/*-linux-gnu",
    "/usr/lib/*-linux-gnu/intel-opencl",
    "/usr/lib64",
    "/usr/lib64/intel-opencl",
    "/opt/rocm*/lib",
    "/opt/amdgpu*/lib/*-linux-gnu",
)
MIN_SPACE = 800 << 20  # [bytes] of address space: with less, builds of small kernels failed
VENDORS = "/etc/OpenCL/vendors"
# Lets the loader of a conda environment read the drivers of VENDORS too.
CONDA_CURE = "conda install -c conda-forge ocl-icd-system"


def conda_prefix():
    """The folder of the conda environment that this pyopencl comes from; None of other pyopencls.

    Its OpenCL loader reads the environment's etc/OpenCL/vendors instead of the system's.
    """
    prefix = os.environ.get("CONDA_PREFIX")
    if not prefix or Path(prefix).resolve() != Path(sys.prefix).resolve():
        return None
    return Path(prefix) if any(Path(prefix, "conda-meta").glob("pyopencl-*.json")) else None


def named_library():
    """Value of CLRESAMPLE_ICD, a library's path or a name that the system resolves; or None."""
    return os.environ.get("CLRESAMPLE_ICD") or None


def register_named_library():
    """Makes the loader read the library of CLRESAMPLE_ICD beside its other drivers.

    Must be called before the process first lists platforms: the loader reads its drivers once.
    FileNotFoundError: CLRESAMPLE_ICD is a path that does not exist
    """
    library = named_library()
    if library is None or Path(os.environ.get("OCL_ICD_VENDORS", "")) == _Vendors.made:
        return
    if "/" in library and not Path(library).exists():
        raise FileNotFoundError(library)
    folder = temporary_folder("icd")
    weakref.finalize(_Vendors, shutil.rmtree, folder, ignore_errors=True)
    for name, known in (_known() | {"clresample.icd": library}).items():
        (folder / name).write_text(known)
    os.environ["OCL_ICD_VENDORS"] = str(folder)
    _Vendors.made = folder


class _Vendors:
    """The folder of .icd files that this process has made for CLRESAMPLE_ICD."""

    made: Path | None = None


def undetected_drivers(served):
    """GPU drivers on this machine that provide no device: [(vendor, path)].

    served: names of platforms that have a GPU; drivers of their vendors are left out
    """
    seen = " ".join(served).upper()
    paths: dict[str, Path] = {}
    for path in _libraries():
        vendor = LIBRARIES[path.name]
        if vendor.upper() not in seen:
            paths.setdefault(vendor, path)
    return list(paths.items())


def driver_fault(library, served):
    """Fault of a driver library that provides no device, in words; None if it has none.

    served: addresses of the platforms that have a device
    """
    try:
        loaded = ctypes.CDLL(library)
    except OSError as error:
        return f"cannot be loaded: {error}"
    platforms = _platforms_of(loaded)
    if platforms is None:
        return "is no OpenCL driver"
    return None if platforms & served else "is an OpenCL driver that finds no device here"


@functools.cache  # once
def warn_named_library(library, served):
    """Warns if the library of CLRESAMPLE_ICD provides no device."""
    if fault := driver_fault(library, served):
        warnings.warn(f"CLRESAMPLE_ICD={library} {fault}", DeviceWarning, stacklevel=3)


def _platforms_of(library):
    """Addresses of a driver library's platforms, as for the loader; None if not a driver."""
    find = getattr(library, "clGetExtensionFunctionAddress", None)
    if find is None:
        return None
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = find(b"clIcdGetPlatformIDsKHR")
    if not address:
        return None
    number = ctypes.c_uint(0)
    whole = ctypes.POINTER(ctypes.c_uint)
    get = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint, ctypes.POINTER(ctypes.c_void_p), whole)(
        address
    )
    if get(0, None, ctypes.byref(number)) != 0:
        return set()
    found = (ctypes.c_void_p * number.value)()
    get(number, found, None)
    return set(found)


def temporary_folder(kind):
    """A folder of this process among the temporary files.

    Folders of processes of this user and machine that have ended are removed first.
    """
    host = re.sub(r"[\W_]", "", platform.node())[:32] or "host"  # containers may share the place
    mine = re.compile(rf"clresample-{kind}-{host}-(\d+)-\w+")
    for entry in list(os.scandir(tempfile.gettempdir())) if os.name == "posix" else ():
        found = mine.fullmatch(entry.name)
        with suppress(OSError):
            if found and entry.stat(follow_symlinks=False).st_uid == os.getuid():
                _remove_of_gone(entry, int(found[1]))
    return Path(tempfile.mkdtemp(prefix=f"clresample-{kind}-{host}-{os.getpid()}-"))


def _remove_of_gone(entry, pid):
    """Removes a folder unless a process has this number, or could have it."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path)
    except OverflowError:
        return


def is_registered(path):
    """True of a driver library that the OpenCL loader has in its list."""
    return path.name in {Path(library).name for library in _known().values()}


def driver_advice(vendor, path, served):
    """Remedy for a GPU's driver library that provides no device, in words.

    served: see `driver_fault`
    """
    driver = f"{vendor}'s OpenCL driver"
    if is_registered(path):
        fault = driver_fault(str(path), served) or "brings no GPU"
        return f"{driver}, {path}, {fault}: is the GPU given to this machine or container?"
    conda = conda_prefix()
    if conda and path.name in {Path(library).name for library in _read(VENDORS).values()}:
        return f"{driver} is at {path}, which the loader of {conda} does not read: {CONDA_CURE}"
    return f"{driver} is at {path}, where the OpenCL loader does not look: {icd_export_line(path)}"


def icd_export_line(path):
    """The shell command, without root, that registers the driver library at `path`."""
    return f"export CLRESAMPLE_ICD={path}"


def _libraries():
    """Paths of all GPU drivers on this machine, those that the system lists first."""
    listed = []
    with suppress(OSError, subprocess.SubprocessError):
        listing = subprocess.run(
            ["/sbin/ldconfig", "-p"], capture_output=True, text=True, check=False, timeout=10
        ).stdout
        listed = [Path(line) for line in re.findall(r"=> (/\S+)", listing)]
    folders = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    folders = [Path(folder) for folder in folders if folder.startswith("/")]
    for pattern in FOLDERS:
        folders += sorted(Path("/").glob(pattern[1:]))
    found = [path for path in listed if path.name in LIBRARIES]
    found += [folder / name for folder in folders for name in LIBRARIES]
    return [path for path in dict.fromkeys(found) if os.path.isfile(path)]


def _known():
    """Drivers that the loader reads in addition to those of pyopencl: {name: library}."""
    if given := os.environ.get("OCL_ICD_VENDORS"):
        is_library = not Path(given).is_dir() and Path(given).suffix != ".icd"
        return {"given.icd": given} if is_library else _read(given)
    conda = conda_prefix()
    return _read(conda / "etc/OpenCL/vendors" if conda else VENDORS)


def _read(place):
    """Libraries named by a folder of .icd files, or by one of them: {name: library}."""
    path = Path(place)
    files = [path] if path.suffix == ".icd" else sorted(path.glob("*.icd"))
    return {file.name: _in_full(file) for file in files}


def _in_full(icd):
    """Library of an .icd file; one beside the file with its folder."""
    library = icd.read_text().strip()
    beside = icd.parent / library
    return str(beside) if beside.is_file() else library


def pocl_cache_fault():
    """Reason why PoCL's device is hidden although its driver is there; None if none is known.

    PoCL offers no device where it cannot write to its cache of built kernels.
    """
    if os.environ.get("POCL_DEVICES"):
        return (
            f"PoCL shows no device for POCL_DEVICES={os.environ['POCL_DEVICES']}: unset it, or set "
            "it to cpu"
        )
    home = Path(os.environ.get("HOME") or "/tmp")
    shared = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "pocl"
    folder = Path(os.environ.get("POCL_CACHE_DIR") or shared)
    if cause := write_fault(folder):
        return (
            f"PoCL cannot write to its cache of built kernels, {folder} ({cause}): "
            "set POCL_CACHE_DIR to a folder that can be written"
        )
    return None


def write_fault(folder):
    """The system's reason why no file can be made in a folder; None if one can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror
    return None


def address_space_warning():
    """Warning if the limit on this process's address space is too low for drivers; or None.

    Below MIN_SPACE, PoCL's compiler ends the process or waits for ever, or no driver is found.
    """
    try:
        import resource
    except ImportError:  # Windows
        return None
    given, _ = resource.getrlimit(resource.RLIMIT_AS)
    if given == resource.RLIM_INFINITY or given >= MIN_SPACE:
        return None
    return (
        f"this process may have {given >> 20} MiB of address space, OpenCL's compiler needs "
        f"{MIN_SPACE >> 20} MiB: raise the limit (ulimit -v unlimited)"
    )
