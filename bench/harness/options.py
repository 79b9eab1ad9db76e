"""The commands' options: their types, their one-line answers, and the surveys they name."""

from __future__ import annotations

import argparse
import math
import os
import re
from pathlib import Path

from clresample import DeviceError
from clresample.files.atomic import FileError
from clresample.simulation.surveys import NOTEBOOK_SURVEYS, PAPER_SURVEYS

ROOT = Path(__file__).resolve().parents[2]
REPORT = ROOT / "bench" / "report"


class BadOption(Exception):
    """A request that cannot be fulfilled; the message is one line for the user."""


class Parser(argparse.ArgumentParser):
    """Options of a command; answers a bad one in one line, with exit status 2.

    doc: of the command's module: its first line, and in "python -m NAME" the command's name
    """

    def __init__(self, doc):
        prog = re.search(r"python -m (\S+)", doc)[1]
        super().__init__(prog, description=doc.splitlines()[0])

    def error(self, message):
        self.exit(2, f"{self.prog}: {message}\n")

    def add(self, name, about, **given):
        """Adds an option; a default, where it is a number or a word, ends its help."""
        shown = given.get("default") is not None and isinstance(given["default"], (int, float, str))
        about = about.replace("%", "%%") + " (%(default)s)" * shown
        self.add_argument(f"--{name}", help=about, **given)

    def add_flag(self, name, about):
        """Adds an option without a value."""
        self.add_argument(f"--{name}", action="store_true", help=about.replace("%", "%%"))

    def add_number(self, name, about, default=None, kind=int, metavar="N", **given):
        """Adds an option of a number above 0, or of several."""
        self.add(name, about, type=positive(kind), default=default, metavar=metavar, **given)

    def add_scenes(self, quick, all_of_them, what="how many scenes"):
        """Adds --quick and --scenes, see `n_scenes`; quick, all_of_them: numbers of scenes."""
        self.set_defaults(scenes_by_default=(all_of_them, quick))
        self.add_flag("quick", f"{quick} scenes")
        self.add_number("scenes", f"{what} ({all_of_them})")

    def add_seed(self, default=0, what="of the first scene"):
        self.add("seed", what, type=seed, default=default, metavar="S")

    def add_json(self):
        self.add("json", "write rows and record there", metavar="FILE", type=Path)

    def add_folder(self):
        about = "results are written there, and an interrupted run goes on from what is there"
        given = {"type": Path, "default": REPORT, "metavar": "FOLDER"}
        self.add("folder", f"{about} (bench/report)", **given)

    def add_sizes(self, sizes):
        about = f"model pixels a side (default: {' '.join(map(str, sizes))})"
        self.add_number("sizes", about, nargs="+")

    def add_seconds(self, seconds, what):
        self.add_number("seconds", f"how long each {what} is measured", seconds, float, "S")

    def add_surveys(self):
        about = "survey parameters as the paper's table prints them, not as its notebooks use them"
        self.add_flag("printed", about)
        about = "survey pairs, such as EUCLID-RUBIN (all 15)"
        self.add("pairs", about, nargs="+", metavar="FROM-TO", type=pair_of_surveys)

    def add_galaxies(self, n_galaxies):
        self.add_number("galaxies", "galaxies in each mean SDR", n_galaxies)
        self.add_catalogue()

    def add_catalogue(self):
        about = "COSMOS galaxies; default: cosmos in CLRESAMPLE_DATA, or in the data folder beside "
        about += "the checkout, or else parametric galaxies"
        self.add("catalogue", about, type=Path, metavar="FOLDER")

    def add_density(self, default=36.0, said=""):
        self.add_number("density", f"sources per square arcminute{said}", default, float)

    def add_sky(self, skies, about):
        self.add("sky", about, choices=skies, default="plain")

    def add_processes(self):
        self.add_number("processes", "processes, of one thread each", 2)


def n_scenes(options):
    """Number of scenes that the options of `Parser.add_scenes` request."""
    return options.scenes or options.scenes_by_default[options.quick]


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
    """Runs `main(options)`; a user's mistake is answered in one line, with exit status 2."""
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
