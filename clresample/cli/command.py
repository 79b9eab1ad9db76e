"""The command `clresample`: one function per subcommand adds its parser and its function.

A subcommand's function takes argparse's subparsers, adds its own, and calls
`parser.set_defaults(run=...)`; `run(arguments)` returns an exit status, None being 0. It raises
ValueError, OSError or DeviceError for a mistake in files or arguments, which becomes one line on
standard error and exit status 2.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import warnings
from contextlib import contextmanager

from .. import __version__
from ..device.device_cache import DeviceWarning
from ..device.discovery import DeviceError
from ..device.kernel_profiler import report
from .cutout import add_cutout
from .deblend import add_deblend
from .device_tools.tune import add_tune
from .devices import add_devices
from .field import add_field
from .fields.report import add_report
from .options import print_note, printable
from .resample import add_resample
from .schema import add_schema
from .simulate import add_simulate

# Largest length of an error's line: some errors quote a whole file.
MAX_CHARACTERS = 900


class Parser(argparse.ArgumentParser):
    """Prints an error in one line, without the usage text."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {printable(message, MAX_CHARACTERS)}\n")


def main(argv=None):
    """Runs `clresample` with these arguments (None: sys.argv's); returns the exit status."""
    with _ended_as_interrupted():
        try:
            return _run(argv)
        except KeyboardInterrupt:  # before a command was known
            print("clresample: interrupted", file=sys.stderr)
            return 130


def parser():
    """The parser of the command with all of its subcommands."""
    whole = Parser(
        prog="clresample", description="Images between telescopes, on any OpenCL device."
    )
    whole.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = whole.add_subparsers(dest="command", metavar="COMMAND")
    for add_command in COMMANDS:
        add_command(commands)
    return whole


def _run(argv):
    parsed = parser()
    arguments = parsed.parse_args(argv)
    if arguments.command is None:
        parsed.print_help()
        return 0
    try:
        with warnings.catch_warnings():
            _show_in_one_line(arguments)
            if getattr(arguments, "profile", False):
                os.environ["CLRESAMPLE_PROFILE"] = "1"  # read when the device is opened
            status = arguments.run(arguments)
            report()
    except DeviceError as error:  # may hold a compiler's log: its lines are kept
        return _fail(arguments, str(error))
    except (ValueError, OSError) as error:
        return _fail(arguments, printable(" ".join(str(error).split()), MAX_CHARACTERS))
    except KeyboardInterrupt:
        _fail(arguments, "interrupted")
        return 130  # what a shell reports after Ctrl-C
    return status or 0


def _show_in_one_line(arguments):
    """Shows a DeviceWarning as a note, without the source line that warnings print."""
    shown = warnings.showwarning

    def show(message, category, *rest, **more):
        if issubclass(category, DeviceWarning):
            print_note(arguments, str(message))
        else:
            shown(message, category, *rest, **more)

    warnings.showwarning = show


def _fail(arguments, message):
    print(f"clresample {arguments.command}: {message}", file=sys.stderr)
    return 2


@contextmanager
def _ended_as_interrupted():
    """Treats SIGTERM like Ctrl-C: fits end with their present state, no partial file stays."""

    def interrupt(*_):
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if former is None else former)


COMMANDS = (
    add_resample,
    add_schema,
    add_deblend,
    add_field,
    add_report,
    add_cutout,
    add_simulate,
    add_devices,
    add_tune,
)
