"""PoCL 3.0 on x86 processors newer than the compiler in it.

PoCL passes the processor's name from its LLVM to its C compiler. For a processor newer than LLVM
14, such as AMD's of 2024 (Zen 5), that name is "generic", which the compiler refuses: no kernel
builds. PoCL 3.1 and later pass another name, but pip provides PoCL 3.0 only, which has no
environment variable for the name. So the name is overwritten in PoCL's record of the device, before
the first build. The new name is that of a processor with the instructions of the function library
that PoCL links on this processor.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

UNKNOWN = "generic"
TRIPLE = "x86_64-unknown-linux-gnu"
# Patterns of that name in the version string of PoCL's device, and of the affected releases.
VERSION = f"-{TRIPLE}-{UNKNOWN}"
RELEASE = "3.0"
RECORD_BYTES = 1024  # of the device's record, in which the name lies at byte 640 in release 3.0
POINTER = ctypes.sizeof(ctypes.c_void_p)
# Processor names of LLVM 14, best first, with the flags of /proc/cpuinfo that they need. PoCL's
# wheel has a library of functions for each (its files kernel-*-avx512.bc and kernel-*-avx2.bc).
# Kernel and library must agree, because the instruction set decides which registers pass arguments.
NAMES = {
    "skylake-avx512": "avx512f avx512bw avx512cd avx512dq avx512vl avx2 fma bmi1 bmi2",
    "haswell": "avx2 fma bmi1 bmi2 f16c movbe",
}


@functools.cache  # once a device; a second time would find no name to set
def set_pocl_cpu_name(device):
    """Sets the processor's name for PoCL if its compiler does not know the detected one.

    device: a pyopencl device, of any platform
    returns the name that was set; None if none was needed or none could be set, in which case the
        device's self-test decides
    """
    if not (device.version.endswith(VERSION) and device.driver_version.startswith(RELEASE)):
        return None
    place, name = _place(device.int_ptr), _known_name(_flags())
    if place is None or name is None:
        return None
    libc = ctypes.CDLL(None)
    libc.strdup.restype = ctypes.c_void_p  # PoCL holds, and may free, memory of malloc
    ctypes.c_void_p.from_address(place).value = libc.strdup(name.encode())
    return name


def _known_name(flags):
    """The first of NAMES whose instructions are all among flags, or None."""
    return next((n for n, needed in NAMES.items() if flags >= set(needed.split())), None)


def _flags():
    """Names of this processor's sets of instructions, as Linux lists them."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return set(next((line for line in lines if line.startswith("flags")), "").split())


def _place(record):
    """Address of the pointer to the processor's name in a device's record, or None.

    record: the record's address; the pointer to the target triple precedes the one to the name
    """
    mapped = _mapped()

    def text_at(place):
        if not _readable(place, POINTER, mapped):
            return None
        found = ctypes.c_void_p.from_address(place).value or 0
        longest = len(TRIPLE) + 1
        return ctypes.string_at(found) if _readable(found, longest, mapped) else None

    places = [
        place
        for place in range(record + POINTER, record + RECORD_BYTES, POINTER)
        if text_at(place) == UNKNOWN.encode() and text_at(place - POINTER) == TRIPLE.encode()
    ]
    return places[0] if len(places) == 1 else None


def _mapped():
    """Stretches of this process's memory that can be read: [(first, end)]."""
    spans = []
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, rights = line.split()[:2]
        if rights.startswith("r"):
            spans.append(tuple(int(end, 16) for end in span.split("-")))
    return spans


def _readable(address, n_bytes, mapped):
    return any(first <= address and address + n_bytes <= end for first, end in mapped)
