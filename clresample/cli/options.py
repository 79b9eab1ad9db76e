"""Shared options of subcommands, the types of their values, and printed lines."""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec

SIZES = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}  # [bytes] powers of 1024, as for memory


def add_device_option(parser, several=False):
    """Adds `--device`, a choice for `get_device`; several: also a list, separated by commas."""
    parser.add_argument(
        "--device",
        metavar="CHOICE",
        help="index, platform:device or part of a name"
        + (", or several by commas, a process each" if several else "")
        + "; without it CLRESAMPLE_DEVICE, then PYOPENCL_CTX, then the first GPU, then the first "
        "CPU",
    )


def add_profile_option(parser):
    """Adds `--profile`, which sets CLRESAMPLE_PROFILE."""
    parser.add_argument(
        "--profile",
        action="store_true",
        help="print at the end how long each kernel took, on standard error",
    )


def add_dtype_option(parser, what):
    """Adds `--dtype`, the floating type of a quantity."""
    parser.add_argument(
        "--dtype",
        choices=("float32", "float64"),
        default="float32",
        help=f"{what} (default %(default)s)",
    )


def print_note(arguments, message):
    """Prints a note for the user on standard error."""
    print_progress(arguments, f"note: {message}")


def print_progress(arguments, message):
    """Prints a line of progress on standard error."""
    print(f"clresample {arguments.command}: {printable(message)}", file=sys.stderr, flush=True)


def printable(text, most=None):
    """A text for a terminal: control characters as their escapes, no more than `most` characters.

    The middle of a longer text is left out, since the end often contains the remedy.
    """
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    if most is None or len(shown) <= most:
        return shown
    return f"{shown[: most // 2]} ... {shown[len(shown) - most // 2 :]}"


def check_matplotlib(option, way_out=""):
    """Raises ValueError if `option` needs matplotlib, which is not installed; imports nothing."""
    if find_spec("matplotlib") is None:
        from ..drawing.figure import NO_MATPLOTLIB

        raise ValueError(f"{option}: {NO_MATPLOTLIB}{way_out}")


def byte_size(text):
    """Bytes: a number, or one with K, M or G (also KiB, MB, ...), in powers of 1024."""
    number = text.upper().removesuffix("B").removesuffix("I")
    unit = number[-1:] if number[-1:] in SIZES else ""
    try:
        n_bytes = float(number.removesuffix(unit)) * SIZES[unit]
    except ValueError:
        n_bytes = 0
    if not 1 <= n_bytes < 1 << 63:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size: use for example 512M or 2G")
    return int(n_bytes)


def name_list(text):
    """Comma-separated names or numbers."""
    found = [part.strip() for part in text.split(",")]
    if not all(found):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a list of bands, such as i or g,r,i or 0,2"
        )
    return found


def center(text):
    """Centre of a PSF: "core", "middle", or Y,X."""
    if text in ("core", "middle"):
        return None if text == "middle" else text
    try:
        y, x = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not core, middle or Y,X") from None
    return y, x


def positive_number(text):
    """A number above zero."""
    number = _number(text)
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return number


def fraction(text):
    """A number from 0 to below 1."""
    number = _number(text)
    if not 0 <= number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be at least 0 and less than 1")
    return number


def non_negative_integer(text):
    """A whole number from 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return int(text)


def _number(text):
    """The number in a text; NaN if the text is not a number."""
    try:
        return float(text)
    except ValueError:
        return float("nan")
