"""Options that subcommands share, and the values they take."""

from __future__ import annotations

import argparse

SIZES = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}  # powers of 1024, as memory is sold


def add_device_option(parser):
    """Add `--device`, whose value `get_device` takes as it is."""
    parser.add_argument(
        "--device",
        metavar="CHOICE",
        help="index, platform:device or part of a name; without it CLRESAMPLE_DEVICE, then "
        "PYOPENCL_CTX, then the first GPU, then the first CPU",
    )


def size(text):
    """Bytes: a number, or one with K, M or G (also KiB, MB, ...), in powers of 1024."""
    number = text.upper().removesuffix("B").removesuffix("I")
    unit = number[-1:] if number[-1:] in SIZES else ""
    try:
        n_bytes = float(number.removesuffix(unit)) * SIZES[unit]
    except ValueError:
        n_bytes = 0
    if not 1 <= n_bytes < 1 << 63:
        raise argparse.ArgumentTypeError(f"{text!r} is no size, such as 512M or 2G")
    return int(n_bytes)


def names(text):
    """Comma-separated names or numbers."""
    found = [part.strip() for part in text.split(",")]
    if not all(found):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of bands, such as i or g,r,i or 0,2")
    return found


def center(text):
    """Where a PSF's centre lies: "core", "middle", or Y,X."""
    if text in ("core", "middle"):
        return None if text == "middle" else text
    try:
        y, x = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not core, middle or Y,X") from None
    return y, x


def positive(text):
    """A number above zero."""
    try:
        number = float(text)
    except ValueError:
        number = 0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no number above 0")
    return number
