"""Times each kernel by OpenCL's own clocks: CLRESAMPLE_PROFILE=1, or --profile.

If CLRESAMPLE_PROFILE is set when a device is opened, every launch is timed. The table is printed on
standard error when the process ends, or by the command at its end. Timing takes some microseconds
a launch. Tables of worker processes, those of fields and of several devices, are added up by the
device's name.
"""

from __future__ import annotations

import atexit
import math
import os
import sys
from collections import defaultdict
from dataclasses import dataclass

# Number of events stored before their times are read: reading waits for the device.
MAX_EVENTS = 2000
# [s] Shorter times are not real: Mesa's llvmpipe reports 1 ns for every launch.
NO_TIME = 1e-8
COLUMNS = ("kernel", "calls", "seconds", "share", "GFLOP/s", "GB/s")


@dataclass
class KernelTimes:
    """Totals over the launches of one kernel.

    flops: counted for matrix products, 0 for other kernels
    n_bytes: sizes of the kernel's buffers, summed over launches: a lower limit of the memory
        traffic of kernels that read or write whole buffers
    """

    n_calls: int = 0
    seconds: float = 0.0
    flops: float = 0.0
    n_bytes: int = 0


class KernelProfiler:
    """The launches of one device since it was opened, by kernel."""

    def __init__(self, name):
        self.name, self._rows, self._events = name, defaultdict(KernelTimes), []

    def record(self, event, kernel, arguments, global_size):
        """Records a launch; arguments {name: value} of the kernel."""
        buffers = {id(v): v for v in arguments.values() if hasattr(v, "size")}
        work = launch_flops(kernel, arguments, global_size), sum(b.size for b in buffers.values())
        self._events.append((event, kernel, work))
        if len(self._events) >= MAX_EVENTS:
            self._read()

    def rows(self):
        """{kernel: KernelTimes} of all launches, after they have finished; longest first."""
        self._read()
        return dict(sorted(self._rows.items(), key=lambda item: -item[1].seconds))

    def table(self):
        """The rows as text, with a line of sums; "" if nothing was launched.

        Without times if the driver does not measure them.
        """
        rows = self.rows()
        total = sum(row.seconds for row in rows.values())
        if not rows:
            return ""
        n_calls = sum(row.n_calls for row in rows.values())
        if total < NO_TIME * n_calls:
            calls = ", ".join(f"{kernel} {row.n_calls}" for kernel, row in rows.items())
            return f"kernels on {self.name}, which does not time them; calls: {calls}"
        cells = [COLUMNS]
        for kernel, row in rows.items():
            rates = [f"{x / row.seconds / 1e9:.1f}" if x and row.seconds else "-"
                     for x in (row.flops, row.n_bytes)]  # fmt: skip
            share = f"{100 * row.seconds / total:.1f} %" if total else "-"
            cells.append((kernel, str(row.n_calls), f"{row.seconds:.4f}", share, *rates))
        cells.append(("all", str(n_calls), f"{total:.4f}", "", "", ""))
        widths = [max(map(len, column)) for column in zip(*cells)]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
            for row in cells
        ]
        return "\n".join([f"kernels on {self.name}:", *lines])

    def add(self, rows):
        """Adds the measurements of another process, {kernel: KernelTimes}."""
        for kernel, row in rows.items():
            mine = self._rows[kernel]
            mine.n_calls += row.n_calls
            mine.seconds += row.seconds
            mine.flops += row.flops
            mine.n_bytes += row.n_bytes

    def clear(self):
        """Clears the tables."""
        self._rows.clear()

    def _read(self):
        events, self._events = self._events, []
        for event, kernel, (n_flops, n_bytes) in events:
            event.wait()
            row = self._rows[kernel]
            row.n_calls += 1
            row.seconds += 1e-9 * (event.profile.end - event.profile.start)
            row.flops += n_flops
            row.n_bytes += n_bytes


def launch_flops(kernel, arguments, global_size):
    """Floating-point operations of a launch's matrix products.

    0 for all other kernels. Items with sizes of their own are counted as the largest, so that rates
    are upper bounds.
    """
    if kernel.startswith("contract"):
        return 2.0 * math.prod(int(arguments[name]) for name in "mnk") * global_size[2]
    if kernel.startswith("mirror"):
        return math.prod(int(arguments[name]) for name in "mnk") * float(global_size[2])
    if kernel == "folded":
        return _folded_flops(arguments)
    return 0.0


def _folded_flops(arguments):
    """Floating-point operations of folded.cl, without the columns that pad its vectors.

    Counted are the products of each source and each target image with even and odd waves along x
    and along y.
    """

    def products(n_y, n_x):
        half_y, half_x = (n_y + 1) // 2, (n_x + 1) // 2
        along_x = 2 * (2 * half_y * half_x * h_x)
        return along_x + 2 * (h_y * half_y * 2 * h_x)

    names = "h_y", "h_x", "n_y", "n_x", "to_n_y", "to_n_x", "n_sources", "n_seen"
    h_y, h_x, n_y, n_x, to_n_y, to_n_x, n, n_seen = (int(arguments[name]) for name in names)
    return 2.0 * n * (products(n_y, n_x) + n_seen * products(to_n_y, to_n_x))


_PROFILES: list[KernelProfiler] = []


def start_profiling(name):
    """A KernelProfiler of a newly opened device; None unless CLRESAMPLE_PROFILE is set."""
    if os.environ.get("CLRESAMPLE_PROFILE", "0") in ("", "0"):
        return None
    return _begun(name)


def _begun(name):
    if not _PROFILES:
        atexit.register(report)
    _PROFILES.append(KernelProfiler(name))
    return _PROFILES[-1]


def drain():
    """Launches since the last call: [(device's name, {kernel: KernelTimes}), ...].

    A worker sends them to its parent process.
    """
    found = [(profile.name, profile.rows()) for profile in _PROFILES]
    for profile in _PROFILES:
        profile.clear()
    return [(name, rows) for name, rows in found if rows]


def add(found):
    """Adds the drained tables of another process, one for each device's name."""
    for name, rows in found:
        same = [profile for profile in _PROFILES if profile.name == name]
        (same[0] if same else _begun(name)).add(rows)


def report():
    """Prints the tables of all profiled devices on standard error and clears them."""
    for profile in _PROFILES:
        table = profile.table()
        if table:
            print(table, file=sys.stderr, flush=True)
        profile.clear()
