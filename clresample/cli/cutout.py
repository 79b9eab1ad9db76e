"""Single sources without their neighbours, after a fit or a whole field: `clresample cutout`."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path

from .options import add_device_option, name_list, print_note

KINDS = "data", "model", "residual", "neighbours", "redistributed"

DESCRIPTION = """\
Cut single sources out of the images of a fit, without their neighbours: the data
minus the models of all other sources, in the instrument's own pixels, with WCS,
standard deviation, mask and PSF. DIR is a folder that `clresample field` or
`clresample deblend` has written into, or a file result.fits."""

EPILOG = """\
what     data           data minus the models of all other sources and the sky
         model          the source's own model
         residual       data minus all models
         neighbours     the models of all other sources
         redistributed  the data, shared among sources in proportion to their models

sources  After `clresample field` ids of the catalogue; after `clresample deblend` the
         sources' names, or their numbers from 0. Sources that an instrument does not
         cover, or that have no model, are left out with a note.

output   A table CUTOUTS with a row for each; of the k-th: DATA, UNCERT, MASK and
         PSFIMAGE with the extension version k. clresample.read_cutouts reads them.

example  clresample cutout sky/out --id N -o alone.fits     # N: a number of the column id,
                                    # clresample.read_catalogue("sky/out/catalogue.fits")["id"]
         clresample cutout sky/out --ids-from bright.ecsv --observation Euclid \\
             --size 64 -o bright.fits
         clresample cutout trial/out --id 0,3 --what redistributed --unit uJy -o two.fits"""


def add_cutout(commands):
    """Adds `clresample cutout`."""
    parser = commands.add_parser(
        "cutout",
        help="single sources without their neighbours",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", metavar="DIR", help="of a field or a fit, or result.fits")
    which = parser.add_argument_group("sources")
    which.add_argument(
        "--id",
        metavar="N,...",
        type=name_list,
        action="extend",
        dest="ids",
        help="a source, or several by commas; may be given again",
    )
    which.add_argument(
        "--ids-from", metavar="FILE", help="a table (FITS, ECSV) whose column id names the sources"
    )
    which.add_argument(
        "--group",
        action="store_true",
        help="take all sources of a field's group (group_id) as one, with each of its members",
    )
    image = parser.add_argument_group("images")
    image.add_argument("--what", choices=KINDS, default="data", help="see below (%(default)s)")
    image.add_argument(
        "--observation",
        metavar="NAME,...",
        type=name_list,
        help="instruments or channels, by name; all instruments by default",
    )
    image.add_argument(
        "--size",
        metavar="SIZE",
        type=extent,
        help="side of the cutout in pixels, or as 5arcsec (default: what holds the source's light)",
    )
    image.add_argument("--unit", metavar="UNIT", help="such as uJy (default: the image's counts)")
    files = parser.add_argument_group("files")
    files.add_argument("-o", "--output", metavar="FILE", required=True, help="FITS file to write")
    files.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    files.add_argument("--quiet", action="store_true", help="no notes")
    add_device_option(parser)
    parser.set_defaults(run=run)


def extent(text):
    """A number of pixels, or an angle as (number, unit)."""
    for unit in ("arcsec", "arcmin", "px", ""):
        number = text.removesuffix(unit).strip()
        if unit and not text.endswith(unit):
            continue
        try:
            value = float(number)
        except ValueError:
            break
        if not 0 < value < 1e6 or (unit in ("px", "") and value != int(value)):
            break
        return (value, unit) if unit in ("arcsec", "arcmin") else (int(value), "")
    raise argparse.ArgumentTypeError(f"{text!r} is not a size: use for example 64 or 5arcsec")


def run(arguments):
    """Runs the command. Raises ValueError and FileError, one line, for unusable arguments."""
    from ..files.atomic import check_folder, check_output

    if not arguments.ids and not arguments.ids_from:
        raise ValueError("--id is missing: give sources by --id N,... or --ids-from FILE")
    path = Path(arguments.output)
    check_output(path, overwrite=arguments.overwrite)
    check_folder(path.absolute().parent)
    from ..deblending.cutouts.choice import MissingSource
    from ..device.multi_device import one_blas_thread
    from ..files.cutouts import write_cutouts

    wanted = [*(arguments.ids or ()), *_listed(arguments)]
    size = None if arguments.size is None else _size(*arguments.size)
    given = {"what": arguments.what, "size": size, "unit": arguments.unit}
    cutout, ids, observations, inputs = _opened(arguments, wanted)
    check_output(path, overwrite=arguments.overwrite, inputs=inputs.values())
    found, missing = [], []
    with one_blas_thread() if len(ids) > 1 else nullcontext():
        for one in dict.fromkeys(ids):
            for observation in observations:
                try:
                    found.append(cutout(one, observation, **given))
                except MissingSource as error:
                    missing.append(str(error))
    if not found:
        raise ValueError(f"nothing to write: {missing[0]}")
    for text in missing if not arguments.quiet else ():
        print_note(arguments, text)
    write_cutouts(path, found, overwrite=arguments.overwrite, inputs=inputs)
    print(f"{len(found)} cutouts of {len(dict.fromkeys(ids))} sources: {path}")


def _size(number, unit):
    if not unit:
        return number
    from astropy import units as u

    return number * u.Unit(unit)


def _listed(arguments):
    """The column id of --ids-from, as texts."""
    if arguments.ids_from is None:
        return []
    from ..files.tables import read_catalogue

    table = read_catalogue(arguments.ids_from)
    if "id" not in table.colnames:
        raise ValueError(f"{arguments.ids_from}: has no column id")
    return [str(one) for one in table["id"].tolist()]


def _opened(arguments, wanted):
    """A function that cuts out a source; sources, observations, and the files that are read."""
    folder = Path(arguments.folder)
    result = folder / "result.fits" if folder.is_dir() else folder
    if folder.is_dir() and not result.is_file():
        return _field(arguments, folder, wanted)
    from ..files.results import read_result

    if arguments.group:
        raise ValueError(f"--group goes with the folder of a field, {result} is a single fit")
    fit = read_result(result)
    ids = [int(one) if one.isdecimal() else one for one in wanted]
    observations = arguments.observation or range(len(fit.observations))
    return fit.cutout, ids, observations, {"fit": result}


def _field(arguments, folder, wanted):
    """As `_opened`, of a field."""
    from ..fields.cutouts import FieldCutouts

    try:
        field = FieldCutouts(folder, device=arguments.device)
        ids = [int(one) for one in wanted]
    except ImportError as error:
        raise ValueError(f"{folder}: {error}") from error
    except ValueError as error:
        if "invalid literal" in str(error):
            raise ValueError(f"--id is {', '.join(wanted)}: ids of a field are numbers") from None
        raise
    for text in field.notes if not arguments.quiet else ():
        print_note(arguments, text)

    def cutout(one, observation, **given):
        return field.cutout(one, observation, group=arguments.group, **given)

    observations = arguments.observation or [mosaic.name for mosaic in field.mosaics]
    return cutout, ids, observations, {"models": folder / "models.fits"}
