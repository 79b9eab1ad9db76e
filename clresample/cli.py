"""The command `clresample`: one function per subcommand adds its parser and names what runs.

A subcommand's function takes argparse's subparsers, adds its own, and calls
`parser.set_defaults(run=...)`; `run(arguments)` raises ValueError, OSError or DeviceError for what
the user can mend, which becomes one line on standard error and exit status 2.
"""

from __future__ import annotations

import argparse
import sys

from . import __version__
from .cli_deblend import add_deblend
from .cli_options import add_device_option
from .cli_resample import add_resample
from .device import DeviceError, get_device, list_devices
from .discover import format_size

COLUMNS = ("platform", "device", "kind", "OpenCL", "units", "memory", "largest buffer", "fp64")


class Parser(argparse.ArgumentParser):
    """Complains in one line, without the usage that `--help` gives."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message}\n")


def main(argv=None):
    """Run `clresample` with these arguments (None: sys.argv's); returns the exit status."""
    parser = Parser(
        prog="clresample", description="Images between telescopes, on any OpenCL device."
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add_command in COMMANDS:
        add_command(commands)
    arguments = parser.parse_args(argv)
    try:
        arguments.run(arguments)
    except DeviceError as error:  # may hold a compiler's log: kept as it is
        return _fail(arguments, str(error))
    except (ValueError, OSError) as error:
        return _fail(arguments, " ".join(str(error).split()))
    except KeyboardInterrupt:
        _fail(arguments, "interrupted")
        return 130  # what a shell reports after Ctrl-C
    return 0


def add_devices(commands):
    """Add `clresample devices`."""
    parser = commands.add_parser(
        "devices",
        help="list the OpenCL devices",
        description="List the OpenCL devices; * marks the one that would be used. "
        "fp64 is found by building a kernel in double precision.",
    )
    add_device_option(parser)
    parser.set_defaults(run=_run_devices)


def _run_devices(arguments):
    print(format_table(list_devices(arguments.device)))
    get_device(arguments.device)  # a choice that fits none is told after the table


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


def _fail(arguments, message):
    print(f"clresample {arguments.command}: {message}", file=sys.stderr)
    return 2


COMMANDS = (add_resample, add_deblend, add_devices)


if __name__ == "__main__":
    sys.exit(main())
