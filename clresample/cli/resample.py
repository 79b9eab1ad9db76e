"""`clresample resample`: an image on the pixels and PSF of another, from FITS to FITS."""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

from .options import (
    add_device_option,
    add_dtype_option,
    add_profile_option,
    byte_size,
    center,
    name_list,
    positive_number,
    print_note,
    printable,
)
from .outputs import file_outputs

# |D|, the noise gain of the difference kernel: a note above the first value, an error above the
# second. Equal PSFs have 1; an image with a hundred times the noise would be useless.
GAIN_WARNED, GAIN_REFUSED = 2.0, 100.0

DESCRIPTION = """\
Show an image as another instrument would have seen it: on the pixels of REF and
with the PSF of REF. Both steps are one exact operation; flux per pixel is kept
as flux per (larger or smaller) pixel. The images must have a celestial WCS."""

EPILOG = """\
bands    A cube is read as (band, y, x). Choose bands by number from 0 or by the name
         in the header (BAND1, BAND2, ..., or FILTER): --band i, --band g,r,i, --band 3.
         The PSF files must then hold one band, or as many as the image.
HDUs     Numbers from 0, NAME or NAME,VERSION; the first image of a file by default.
PSFs     Images in the pixels of their instrument, pixel response included, centred on
         the middle of the array: --psf-center core where they are not.
output   The image with REF's WCS, an extension COVERAGE (1 where IN covers a pixel, 0
         elsewhere, where the image is 0), and how it was made in the header.

example  clresample resample hst.fits --psf psf_hst.fits --psf-center core \\
             --like hsc_grizy.fits --like-band 3 \\
             --psf-like psf_hsc_grizy.fits --psf-like-band 3 -o hst_as_hsc.fits"""


def add_resample(commands):
    """Adds `clresample resample`."""
    parser = commands.add_parser(
        "resample",
        help="show an image on the pixels and PSF of another",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("image", metavar="IN.fits", help="image or cube to resample")
    _add_files(parser.add_argument_group("files"))
    _add_parts(parser.add_argument_group("parts of the files"))
    _add_psfs(parser.add_argument_group("PSFs"))
    _add_ways(parser.add_argument_group("how"))
    parser.set_defaults(run=run)


def _add_files(group):
    group.add_argument("--psf", required=True, metavar="P.fits", help="PSF of IN, in its pixels")
    group.add_argument(
        "--like", required=True, metavar="REF.fits", help="image whose pixels to take"
    )
    group.add_argument(
        "--psf-like", required=True, metavar="Q.fits", help="PSF of REF, in its pixels"
    )
    group.add_argument("-o", "--output", required=True, metavar="OUT.fits", help="file to write")
    group.add_argument("--overwrite", action="store_true", help="replace OUT and PNG if they exist")
    group.add_argument(
        "--plot", metavar="PNG", help="also draw IN and OUT, and beside REF where its bands match"
    )


def _add_parts(group):
    for prefix, name in (("", "IN"), ("psf-", "P"), ("like-", "REF"), ("psf-like-", "Q")):
        group.add_argument(f"--{prefix}hdu", metavar="HDU", help=f"HDU of {name}")
        drawn = ", to draw" if name == "REF" else ""
        group.add_argument(
            f"--{prefix}band",
            metavar="BANDS",
            type=name_list,
            help=f"bands of {name}{drawn}; all by default",
        )


def _add_psfs(group):
    for prefix, name in (("psf-", "P"), ("psf-like-", "Q")):
        group.add_argument(
            f"--{prefix}spacing",
            metavar="PX",
            type=positive_number,
            default=1.0,
            help=f"distance of {name}'s samples in pixels: 0.5 if oversampled twice (default 1)",
        )
        group.add_argument(
            f"--{prefix}center",
            metavar="WHERE",
            type=center,
            help=f"centre of {name}: middle (of the array, default), core, or Y,X from 0",
        )
    group.add_argument(
        "--max-gain",
        metavar="G",
        type=positive_number,
        default=GAIN_REFUSED,
        help="refuse PSFs that need sharpening by more than this (default %(default)g)",
    )


def _add_ways(group):
    group.add_argument(
        "--shift",
        nargs=2,
        type=float,
        default=(0.0, 0.0),
        metavar=("DY", "DX"),
        help="move every output pixel by so many pixels of IN, where the two WCS disagree",
    )
    group.add_argument(
        "--fill-nan",
        type=float,
        metavar="VALUE",
        help="put VALUE for NaN and infinite pixels of IN",
    )
    add_dtype_option(group, "arithmetic and output")
    add_device_option(group)
    add_profile_option(group)
    group.add_argument(
        "--memory",
        metavar="SIZE",
        type=byte_size,
        help="device memory to stay within, as 512M or 2G; larger frames go through in tiles "
        "(default: 1G, or a quarter of the device's)",
    )


def run(arguments):
    """Runs the command. Raises ValueError or OSError, one line, for unusable arguments."""
    inputs = {
        "image": arguments.image,
        "its PSF": arguments.psf,
        "pixels of": arguments.like,
        "PSF of these": arguments.psf_like,
    }
    paths = file_outputs(arguments, inputs.values())
    from ..device.device import get_device
    from ..device.mirror_contraction import operator_programs

    device = get_device(arguments.device)
    device.build_ahead(operator_programs(device, arguments.dtype))
    from ..fields.field_toml.headers import AREAS
    from ..files.atomic import atomic_files
    from ..files.fits import read_image, write_fits  # a quarter of a second of astropy

    image = read_image(arguments.image, hdu=arguments.hdu, bands=arguments.band)
    pixels = _finite(arguments, image)
    reference = read_image(arguments.like, hdu=arguments.like_hdu, bands=arguments.like_band)
    psfs = [_psf(arguments, which, len(pixels)) for which in ("psf", "psf_like")]
    unit = str(image.header.get("BUNIT") or "")
    if any(area in unit.lower() for area in AREAS):
        print_note(
            arguments, f"{arguments.image}: BUNIT is {unit}, but pixels are taken as flux per pixel"
        )

    started = time.perf_counter()
    op = _operator(arguments, device, image.grid, reference.grid, psfs)
    result = _resampled(arguments, op, pixels)
    took = time.perf_counter() - started
    written = result if len(result) > 1 else result[0]
    with atomic_files(paths) as parts:
        write_fits(
            parts[0],
            written,
            reference.grid,
            bands=None if all(band.isdigit() for band in image.bands) else image.bands,
            coverage=op.covered,
            unit=unit,
            device=op.device.name,
            inputs=inputs,
            shift_px=arguments.shift,
        )
        if arguments.plot:
            from ..files.plot_resampled import plot_resampled

            files = Path(arguments.image).name, Path(arguments.like).name
            plot_resampled(parts[1], image, reference, result, op.covered, psfs[1], names=files)
    print(
        f"{printable(arguments.output)}: {' x '.join(map(str, written.shape))} pixels, "
        f"{100 * op.covered.mean():.3g} % covered; {op.geometry} grids, {op.n_tiles} "
        f"tile{'s' * (op.n_tiles > 1)}, {took:.2f} s on {op.device.name}"
    )
    if arguments.plot:
        print(printable(arguments.plot))


def _operator(arguments, device, grid_in, grid_out, psfs):
    """The TiledResampler; prints notes on its gain and its floored power if they are large.

    Raises ValueError for grids that do not overlap, too little memory and too much gain.
    """
    from ..resampling.tiled.resampler import TiledResampler
    from ..resampling.transfer import FLOORED_POWER

    try:
        op = TiledResampler(
            grid_in,
            psfs[0],
            grid_out,
            psfs[1],
            dtype=arguments.dtype,
            device=device,
            shift=arguments.shift,
            memory=arguments.memory,
        )
    except ValueError as error:
        raise ValueError(f"{arguments.image} as {arguments.like}: {error}") from error
    gain = float(op.certificate.max_gain.max())
    message = (
        f"{arguments.psf} is wider than {arguments.psf_like} can show: sharpening it raises noise "
        f"up to {gain:.3g} times"
    )
    if gain > arguments.max_gain:
        raise ValueError(f"{message}, more than --max-gain {arguments.max_gain:g}")
    if gain > GAIN_WARNED:
        print_note(arguments, message)
    floored = float(op.certificate.floored_power.max())
    if floored > FLOORED_POWER:
        print_note(
            arguments,
            f"{floored:.2%} of {arguments.psf_like}'s power lies beyond {arguments.psf}: floored",
        )
    return op


def _resampled(arguments, op, pixels):
    """The result. Raises ValueError where it has overflowed."""
    import numpy as np

    try:
        with np.errstate(over="ignore"):  # NumPy's warning; the error below is more specific
            result = op(pixels)
    except ValueError as error:  # of pixels that the type cannot hold
        reason = str(error).replace("dtype=", "--dtype ")
        raise ValueError(f"{arguments.image}: {reason}") from error
    n_bad = int(np.count_nonzero(~np.isfinite(result)))
    if n_bad:
        raise ValueError(
            f"{arguments.image}: {n_bad} of {result.size} resampled pixels are too large for "
            f"{arguments.dtype}: divide the image by a power of ten"
            + (", or use --dtype float64" if arguments.dtype == "float32" else "")
        )
    return result


def _finite(arguments, image):
    """The image's pixels; NaN and infinite ones have the value of --fill-nan, or are refused."""
    import numpy as np

    if image.n_invalid and arguments.fill_nan is None:
        raise ValueError(
            f"{arguments.image}: {image.n_invalid} of {image.data.size} pixels are NaN or "
            f"infinite, "
            "and would spread; --fill-nan 0 puts 0 there"
        )
    if image.n_invalid:
        return np.where(
            np.isfinite(image.data), image.data, image.data.dtype.type(arguments.fill_nan)
        )
    return image.data


def _psf(arguments, which, n_bands):
    """PSF `which` ("psf" or "psf_like") with as many bands as the image; its warnings as notes."""
    from ..files.fits import read_psf
    from ..sky.psf_checks import PSFWarning, check_edge

    option = "--" + which.replace("_", "-")
    path, hdu, bands, spacing, where = (
        getattr(arguments, which + part) for part in ("", "_hdu", "_band", "_spacing", "_center")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)  # printed below, with the name of the option
        psf = read_psf(path, hdu=hdu, bands=bands, spacing=spacing, center=where)
    try:
        check_edge(psf.images)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    for message in psf.warnings(core=f"{option}-center core"):
        print_note(arguments, f"{path}: {message}")
    if psf.n_bands not in (1, n_bands):
        raise ValueError(
            f"{path}: has {psf.n_bands} bands, {arguments.image} {n_bands}: choose with --band and "
            f"{option}-band"
        )
    return psf.select([0] * n_bands) if psf.n_bands == 1 else psf
