"""The commands' options: their types, their one-line answers, and the surveys they name."""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path

from clresample import DeviceError
from clresample.files.atomic import FileError
from clresample.simulation.surveys import NOTEBOOK_SURVEYS, PAPER_SURVEYS

ROOT = Path(__file__).resolve().parents[2]
REPORT = ROOT / "bench" / "report"


class BadOption(Exception):
    """What a user asked for cannot be done; the message is one line."""


class Parser(argparse.ArgumentParser):
    """Answers a bad option in one line, with exit status 2."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message}\n")

    def add_json(self):
        self.add_argument("--json", metavar="FILE", type=Path, help="write rows and record there")

    def add_folder(self):
        self.add_argument(
            "--folder",
            type=Path,
            default=REPORT,
            metavar="FOLDER",
            help="the report's: results are written there, and an interrupted run goes on from "
            "what is there (bench/report)",
        )

    def add_sizes(self, sizes):
        self.add_argument(
            "--sizes",
            nargs="+",
            metavar="N",
            type=positive(int),
            help=f"model pixels a side (default: {' '.join(map(str, sizes))})",
        )

    def add_seconds(self, seconds, what):
        self.add_argument(
            "--seconds",
            type=positive(float),
            default=seconds,
            metavar="S",
            help=f"how long each {what} is measured (%(default)s)",
        )

    def add_surveys(self):
        self.add_argument(
            "--printed",
            action="store_true",
            help="survey parameters as the paper's table prints them, "
            "not as its notebooks use them",
        )
        self.add_argument(
            "--pairs",
            nargs="+",
            metavar="FROM-TO",
            type=pair_of_surveys,
            help="survey pairs, such as EUCLID-RUBIN (all 15)",
        )

    def add_galaxies(self, n_galaxies):
        self.add_argument(
            "--galaxies",
            type=positive(int),
            default=n_galaxies,
            metavar="N",
            help="galaxies in each mean SDR (%(default)s)",
        )
        self.add_catalogue()

    def add_catalogue(self):
        self.add_argument(
            "--catalogue",
            type=Path,
            metavar="FOLDER",
            help="COSMOS galaxies; default: cosmos in CLRESAMPLE_DATA, or in the "
            "data folder beside the checkout, or else parametric galaxies",
        )

    def add_first_seed(self, default):
        self.add_argument(
            "--seed",
            type=seed,
            default=default,
            metavar="S",
            help="seed of the first scene (%(default)s)",
        )

    def add_density(self, default=36.0, said="36"):
        self.add_argument(
            "--density",
            type=positive(float),
            default=default,
            metavar="N",
            help=f"sources per square arcminute ({said})",
        )

    def add_sky(self):
        self.add_argument(
            "--sky",
            choices=("plain", "real", "bright"),
            default="plain",
            help="of simulated fields, see simulate_field (%(default)s)",
        )

    def add_processes(self):
        self.add_argument(
            "--processes",
            type=positive(int),
            default=2,
            metavar="N",
            help="processes, of one thread each (%(default)s)",
        )


def positive(kind):
    """An option's type: a number of `kind` above 0."""

    def convert(text):
        value = kind(text)
        if not 0 < value < math.inf:
            raise argparse.ArgumentTypeError(f"{text} is not above 0")
        return value

    convert.__name__ = f"positive {kind.__name__}"
    return convert


def seed(text):
    """An option's type: a whole number, 0 or more."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return value


def pair_of_surveys(text):
    """An option's type: FROM-TO as two names, TO not finer than FROM."""
    names = tuple(text.upper().split("-"))
    if names not in survey_pairs():
        raise argparse.ArgumentTypeError(
            f"{text} is not FROM-TO, two of {', '.join(NOTEBOOK_SURVEYS)} in this order"
        )
    return names


def survey_table(printed):
    """Survey parameters by name: those of the paper's table, or those of its notebooks."""
    return PAPER_SURVEYS if printed else NOTEBOOK_SURVEYS


def survey_pairs():
    """The 15 pairs of surveys, the finer first, each survey with itself included."""
    names = list(NOTEBOOK_SURVEYS)
    return [(a, b) for i, a in enumerate(names) for b in names[i:]]


def data_folder():
    """Folder of real images and catalogues: CLRESAMPLE_DATA, or shared/data beside the checkout."""
    return Path(os.environ.get("CLRESAMPLE_DATA") or ROOT.parent / "shared" / "data")


def run(main, parser):
    """Run `main(options)`; a user's mistake is answered in one line, with exit status 2."""
    options = parser.parse_args()
    json_file, folder = (getattr(options, name, None) for name in ("json", "folder"))
    try:
        if json_file and (json_file.is_dir() or not json_file.resolve().parent.is_dir()):
            raise BadOption(f"--json {json_file} is not a file in a folder that exists")
        if folder:
            _make_folder(folder)
        main(options)
    except (BadOption, DeviceError, FileError, ImportError) as error:
        parser.error(" ".join(str(error).split()))


def _make_folder(folder):
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadOption(f"--folder {folder}: {error.strerror}") from error
