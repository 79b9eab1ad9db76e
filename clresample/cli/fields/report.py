"""A run over a field as one HTML page: `clresample report`."""

from __future__ import annotations

import argparse

from ..options import byte_size, print_note

DESCRIPTION = """\
Write one HTML page about a run of `clresample field`, finished or not: the field
to zoom into (data, model, residual), every source with its pictures in all
channels, number counts, signal to noise, a map of chi2, pulls where the truth is
known, the slowest and the failed fits. The page needs no network and no other
file."""

EPILOG = """\
example  clresample simulate field -o sky
         clresample field sky/field.toml -o sky/out
         clresample report sky/out"""


def add_report(commands):
    """Adds `clresample report`."""
    parser = commands.add_parser(
        "report",
        help="one HTML page about a field",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", metavar="DIR", help="that `clresample field` has written into")
    parser.add_argument(
        "-o", "--output", metavar="FILE", help="page to write (default DIR/report.html, replaced)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    parser.add_argument(
        "--truth",
        metavar="FILE",
        help="true sources, a table with y, x [px] and flux_CHANNEL [uJy] (default truth.ecsv in "
        "DIR, beside it or beside the run's inputs, if there is one)",
    )
    parser.add_argument(
        "--max-size",
        metavar="SIZE",
        type=byte_size,
        help="of the page; what does not fit is left out, the finest images first (default 64M)",
    )
    parser.set_defaults(run=run)


def run(arguments):
    """Writes the page. Raises ValueError and FileError, one line, for unusable arguments."""
    from ...report.write import MAX_BYTES, write_report

    report = write_report(
        arguments.folder,
        arguments.output,
        truth=arguments.truth,
        most_bytes=arguments.max_size or MAX_BYTES,
        overwrite=arguments.overwrite,
    )
    for text in report.notes:
        print_note(arguments, text)
    print(report.path)
