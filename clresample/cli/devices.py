"""The table of OpenCL devices: `clresample devices`."""

from __future__ import annotations

import warnings

from ..device.discovery import HIDDEN_GPU, driver_hints, format_size, list_devices
from .options import add_device_option, print_note

COLUMNS = ("platform", "device", "kind", "OpenCL", "units", "memory", "largest buffer", "fp64")


def add_devices(commands):
    """Adds `clresample devices`."""
    parser = commands.add_parser(
        "devices",
        help="list the OpenCL devices",
        description="List the OpenCL devices; * marks the one that would be used. "
        "fp64 is found by building a kernel in double precision.",
    )
    add_device_option(parser)
    parser.add_argument(
        "--bench", action="store_true", help="measure the chosen device, within ten seconds"
    )
    parser.set_defaults(run=run)


def run(arguments):
    """Prints the table. Raises DeviceError, after the table, if the choice matches no device."""
    from ..device.device import get_device

    print(format_table(list_devices(arguments.device)))
    for hint in driver_hints():
        print_note(arguments, hint)
    warnings.filterwarnings("ignore", HIDDEN_GPU)  # the hints have said it
    device = get_device(arguments.device)
    if arguments.bench:
        from .device_tools.bench import bench_lines

        print(f"\n{device.name}:")
        for line in bench_lines(device):
            print(f"  {line}", flush=True)


def format_table(devices):
    """The DeviceInfo rows as aligned text."""
    rows = [("", "#", *COLUMNS)]
    for info in devices:
        rows.append(
            (
                "*" if info.chosen else "",
                str(info.index),
                info.platform,
                info.name,
                info.kind,
                info.version.removeprefix("OpenCL "),
                str(info.compute_units),
                format_size(info.memory),
                format_size(info.max_alloc),
                {True: "yes", False: "no", None: "?"}[info.fp64],
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
    return "\n".join(lines)
