"""Cores and memory that this process may use of its machine.

In containers and batch jobs that is often less than the machine has, by the limits of their control
groups (Linux, versions 1 and 2).
"""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

CGROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
MEMORY_INFO = Path("/proc/meminfo")
UNKNOWN_MEMORY = 2 << 30  # [bytes] on other systems


def n_host_cores() -> int:
    """Number of cores that this process may use: of its affinity, and of its share of time."""
    affinity = getattr(os, "sched_getaffinity", None)
    n = len(affinity(0)) if affinity else os.cpu_count() or 1
    for folder in _groups("cpu"):
        with suppress(OSError, ValueError, ZeroDivisionError):
            if (folder / "cpu.max").exists():
                quota, period = (folder / "cpu.max").read_text().split()
            else:
                names = "cpu.cfs_quota_us", "cpu.cfs_period_us"
                quota, period = ((folder / name).read_text() for name in names)
            if float(quota) > 0:  # "max", or -1, of one without a limit
                n = min(n, math.ceil(float(quota) / float(period)))
    return max(n, 1)


def free_memory() -> int:
    """Free memory [bytes], with what caches would give up, within the limit of its groups."""
    found = [_unused()]
    for folder in _groups("memory"):
        for limit, used in (
            ("memory.max", "memory.current"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes"),
        ):
            with suppress(OSError, ValueError):
                most, taken = (int((folder / name).read_text()) for name in (limit, used))
                found.append(most - taken + _values(folder / "memory.stat").get("inactive_file", 0))
    return max(min(found), 0)


def _unused():
    """Free memory [bytes] of the whole machine."""
    with suppress(OSError, KeyError):
        return 1024 * _values(MEMORY_INFO)["MemAvailable:"]
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return UNKNOWN_MEMORY


def _values(path):
    """{name: number} of lines of a name, a number, and perhaps a unit."""
    words = (line.split() for line in path.read_text().splitlines())
    return {name: int(value) for name, value, *_ in words if value.isdecimal()}


def _groups(controller):
    """Folders of this process's control groups for "cpu" or "memory", and of those above them."""
    with suppress(OSError, ValueError):
        for line in OWN_GROUPS.read_text().splitlines():
            _, names, path = line.split(":", 2)
            if not names or controller in names.split(","):
                top = CGROUPS / (controller if names else "")
                folder = top / path.strip("/")
                yield from (folder, *(f for f in folder.parents if f.is_relative_to(top)))
