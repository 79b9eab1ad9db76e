"""Survey mosaics to one catalogue: `clresample field`."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

from .options import (
    add_device_option,
    add_profile_option,
    byte_size,
    non_negative_integer,
    positive_number,
    print_note,
)

DESCRIPTION = """\
Find, fit and measure every source of a field: mosaics of any size, of several
instruments, each with its own pixels, orientation and PSF. The field is searched
in tiles, sources are linked into blends by their light, and blends are fitted in
groups. What is finished stays on disk: --resume goes on after any interruption
and ends with the same catalogue."""

EPILOG = """\
in DIR   catalogue.parquet, .fits, .ecsv   fluxes with errors, positions, shapes, flags
         hats/                             the catalogue for LSDB, with --hats
         fit_table.ecsv                       fits: how they ended, sizes, seconds
         models.fits                       every source's model, by blend
         model_*.fits, residual_*.fits     mosaics
         provenance.json                   versions, device, settings, input checksums
         work/                             what --resume goes on from

exit     0 all is done   1 done, but tiles are lost or fits set aside, each with its
         reason   2 nothing could be done   130 interrupted: --resume goes on

example  clresample simulate field -o sky
         clresample field sky/field.toml -o sky/out
         clresample report sky/out"""


def add_field(commands):
    """Adds `clresample field`."""
    parser = commands.add_parser(
        "field",
        help="one catalogue of whole mosaics",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("field", metavar="FIELD.toml", help="mosaics, and how they are run")
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="to write into")
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with the run in DIR")
    again.add_argument("--overwrite", action="store_true", help="forget the run in DIR")
    parser.add_argument(
        "--workers",
        metavar="N",
        type=non_negative_integer,
        help="processes that search and fit; 0 = this one (default: one for each core of a CPU "
        "with 1.5 GB of free memory, one for each GPU)",
    )
    parser.add_argument(
        "--worker-memory",
        metavar="SIZE",
        type=byte_size,
        help="private memory that a worker process may take, at least 1G, held by the system on "
        "Linux; groups of fits are sized for it. Without it they take 1G by prediction, or an "
        "eighth of the free memory where that is less, and a worker what it needs",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="the workers of this dask.distributed scheduler search and fit, as tcp://HOST:8786; "
        "they need this package and the mosaics' files",
    )
    parser.add_argument(
        "--timeout",
        metavar="S",
        type=positive_number,
        default=3600.0,
        help="seconds after which a worker is taken to hang (default %(default)g)",
    )
    parser.add_argument(
        "--part",
        metavar="I/N",
        type=_part,
        help="only the I-th of N parts of the field, for job arrays: sources belong to the part "
        "that holds their centre, so that the parts' catalogues together are that of the field",
    )
    parser.add_argument(
        "--hats",
        action="store_true",
        help="write the catalogue as HATS too, which LSDB opens (extra hats)",
    )
    add_device_option(parser, several=True)
    add_profile_option(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")
    parser.set_defaults(run=run)


def _part(text):
    """I/N as two whole numbers."""
    i, _, n = text.partition("/")
    if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a part: use for example 2/4")
    return int(i), int(n)


def run(arguments):
    """Reads the field file, runs the field and reports. Returns the exit status."""
    import os

    # other threads have small matrices too: see one_blas_thread
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from ..fields.field_toml.field_file import read_field
    from ..fields.options import MIN_BOUND
    from ..fields.run import run_field
    from .fields.progress import ProgressDisplay

    started = time.perf_counter()
    try:
        field = read_field(arguments.field)
    except ImportError as error:
        raise ValueError(f"{arguments.field}: {error}") from error
    if not arguments.quiet:
        for text in field.notes:
            print_note(arguments, text)
    if arguments.worker_memory is not None and arguments.worker_memory < MIN_BOUND:
        raise ValueError(
            f"--worker-memory is {arguments.worker_memory >> 20}M, must be {MIN_BOUND >> 30}G or "
            f"more"
        )
    devices = arguments.device.split(",") if arguments.device else []
    workers = arguments.workers
    if workers is None:
        workers = len(devices) if len(devices) > 1 else _n_workers(arguments, *devices)
    options = replace(
        field.options,
        workers=workers,
        device=devices or None,
        scheduler=arguments.scheduler,
        task_timeout_s=arguments.timeout,
        part=arguments.part,
        hats=arguments.hats,
        worker_memory=arguments.worker_memory,
    )
    progress = ProgressDisplay(arguments)
    try:
        done = run_field(
            field.mosaics,
            arguments.output,
            options=options,
            resume=arguments.resume,
            overwrite=arguments.overwrite,
            progress=progress,
            about={"inputs": field.inputs},
        )
    except ImportError as error:
        raise ValueError(f"{arguments.field}: {error}") from error
    finally:
        progress.close()
    return _report(arguments, done, time.perf_counter() - started)


def _n_workers(arguments, device=None):
    """Number of workers for a device, where the command does not say it."""
    from ..device.discovery import choose
    from ..device.multi_device import PROCESS_MEMORY, n_beside

    if arguments.scheduler is not None:
        return 1
    return n_beside(choose(device), max(PROCESS_MEMORY, arguments.worker_memory or 0))


def _report(arguments, done, took):
    """Prints a summary and the files written; returns the exit status."""
    out = done.outputs
    ended = ", ".join(f"{n} {how}" for how, n in sorted(out.status.items()))
    stages = ", ".join(f"{name} {s:.1f} s" for name, s in done.seconds.items())
    print(f"{out.n_sources} sources in {out.n_blends} fits ({ended or 'none'})")
    print(f"{took:.1f} s: {stages}")
    for number, reason in done.failed_tiles.items():
        print(f"error: tile {number} is lost, with all of its sources: {reason}", file=sys.stderr)
    if not arguments.quiet:
        for text in out.notes:
            print_note(arguments, text)
    for path in out.paths:
        print(path)
    return 1 if done.failed_tiles or done.failed else 0
