"""Options of `clresample simulate field`: the simulated sky and its images."""

from __future__ import annotations

import argparse
import sys

from ..options import name_list, non_negative_integer, positive_number


def _up_to(largest, said):
    """An option's type: a number from 0 to `largest`; `said` is that range in error messages."""

    def convert(text):
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not 0 <= number <= largest:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number {said}")
        return number

    return convert


_part, _size = _up_to(1, "from 0 to 1"), _up_to(sys.float_info.max, "of 0 or more")


def add_sky(sky):
    """Adds the options of the group `sky`."""
    sky.add_argument("--seed", type=non_negative_integer, default=0, help="(default %(default)s)")
    sky.add_argument(
        "--size",
        type=non_negative_integer,
        default=512,
        metavar="PX",
        help="Euclid pixels a side (%(default)s)",
    )
    sky.add_argument(
        "--sky",
        choices=["plain", "real", "bright"],
        default="plain",
        help="plain: small galaxies; real: counts and sizes as published, to 20 arcsec; bright: "
        "six bright galaxies of 8 to 30 px, 160 small ones, five stars (%(default)s)",
    )
    sky.add_argument(
        "--large",
        type=non_negative_integer,
        default=0,
        metavar="N",
        help="galaxies of 2 to 20 arcsec added to a real sky (%(default)s)",
    )
    sky.add_argument(
        "--density",
        type=positive_number,
        metavar="N",
        help="sources per square arcminute to i = 26 (36; real: as published)",
    )
    for name, default, said, what in (
        ("clustering", 0.2, "0.2", "fraction of the sources that lie close to another one"),
        ("stars", None, "0.05; real: as published", "fraction of the sources that are stars"),
        ("psf-variation", 0.1, "0.1", "relative growth of PSF widths across the field"),
    ):
        sky.add_argument(
            f"--{name}", type=_part, default=default, metavar="F", help=f"{what} ({said})"
        )


def add_images(images):
    """Adds the options of the group `images`."""
    images.add_argument(
        "--bands",
        type=name_list,
        default=list("ugrizy"),
        metavar="B,...",
        help="of Rubin (default u,g,r,i,z,y)",
    )
    images.add_argument(
        "--angle", type=float, default=12.0, metavar="DEG", help="of Rubin's pixels (%(default)s)"
    )
    images.add_argument(
        "--bad-columns",
        type=non_negative_integer,
        default=2,
        metavar="N",
        help="of each mosaic (%(default)s)",
    )
    images.add_argument(
        "--format",
        choices=["plain", "survey"],
        default="plain",
        help="plain: FITS cubes with RMS, MASK and PSFs; survey: Euclid as a tile of MER, Rubin as "
        "cell coadds, whose PSF is constant in a cell (%(default)s)",
    )
    images.add_argument(
        "--spoilers",
        type=_size,
        metavar="F",
        help="factor of the sizes of the images' faults: offsets of WCS, wrong PSFs, residual sky, "
        "cosmic rays, chip gaps; 1 = as in surveys, 0 = none (real: 1, bright: saturation alone)",
    )
