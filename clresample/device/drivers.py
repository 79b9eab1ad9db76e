"""Driver libraries: one that CLRESAMPLE_ICD names, and GPUs' that the OpenCL loader does not see.

The loader (libOpenCL) learns of drivers from .icd files, each of which names a library. Containers
often have a GPU's library without its .icd file.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path

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
VENDORS = "/etc/OpenCL/vendors"


def named_library():
    """What CLRESAMPLE_ICD names, or None: a library's path, or a name the system finds it by."""
    return os.environ.get("CLRESAMPLE_ICD") or None


def show_named_library():
    """Have the loader read the library of CLRESAMPLE_ICD beside the drivers that it reads anyway.

    It must be called before the process asks pyopencl for platforms: the loader reads once.
    FileNotFoundError: CLRESAMPLE_ICD is a path where there is nothing
    """
    library = named_library()
    if library is None or Path(os.environ.get("OCL_ICD_VENDORS", "")) == _Vendors.made:
        return
    if "/" in library and not Path(library).exists():
        raise FileNotFoundError(library)
    folder = Path(tempfile.mkdtemp(prefix="clresample-icd-"))
    weakref.finalize(_Vendors, shutil.rmtree, folder, ignore_errors=True)
    for name, known in (_known() | {"clresample.icd": library}).items():
        (folder / name).write_text(known)
    os.environ["OCL_ICD_VENDORS"] = str(folder)
    _Vendors.made = folder


class _Vendors:
    """The folder of .icd files that this process has made for CLRESAMPLE_ICD."""

    made: Path | None = None


def unseen(served):
    """GPU drivers on this machine that brought no device: [(vendor, path)].

    served: names of platforms that have a GPU; their vendors' drivers are not looked for
    """
    seen = " ".join(served).upper()
    paths: dict[str, Path] = {}
    for path in _libraries():
        vendor = LIBRARIES[path.name]
        if vendor.upper() not in seen:
            paths.setdefault(vendor, path)
    return list(paths.items())


def fault_of(library):
    """Why a driver library cannot be loaded, in the system's words; None where it can."""
    try:
        ctypes.CDLL(library)
    except OSError as error:
        return str(error)
    return None


def cure(path):
    """The line to type, without root, that lets clresample see the driver library at `path`."""
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
    return [path for path in dict.fromkeys(found) if path.is_file()]


def _known():
    """What the loader reads beside the drivers that come with pyopencl: {name: library}."""
    given, files = os.environ.get("OCL_ICD_VENDORS"), []
    place = Path(given or VENDORS)
    if place.is_dir():
        files = sorted(place.glob("*.icd"))
    elif place.suffix == ".icd":
        files = [place]
    known = {file.name: _in_full(file) for file in files}
    if given and not files and not place.is_dir():  # a library, by its path or name
        known["given.icd"] = given
    return known


def _in_full(icd):
    """What an .icd file names; a library beside it with its folder."""
    library = icd.read_text().strip()
    beside = icd.parent / library
    return str(beside) if beside.is_file() else library
