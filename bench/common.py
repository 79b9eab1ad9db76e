"""Pieces that all benchmarks share: options, one thread, timing, tables and records."""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import platform
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from clresample import DeviceError, __version__, get_device
from clresample.simulation.surveys import NOTEBOOK_SURVEYS, PAPER_SURVEYS

ROOT = Path(__file__).resolve().parents[1]
REPORT = ROOT / "bench" / "report"
# Calls of a fast function for each call of the slowest, so that its median is one of many.
MAX_REPEATS = 20


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
            help="of the report: results go there, and an interrupted run continues from there "
            "(bench/report)",
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


def survey_pairs():
    """The 15 pairs of surveys, the finer first, each survey with itself included."""
    names = list(NOTEBOOK_SURVEYS)
    return [(a, b) for i, a in enumerate(names) for b in names[i:]]


def data_folder():
    """Folder of real images and catalogues: CLRESAMPLE_DATA, or one beside the checkout."""
    return Path(os.environ.get("CLRESAMPLE_DATA") or ROOT.parent / "shared" / "data")


def run(main, parser):
    """Run `main(options)`; what a user can mend is told in one line, with exit status 2."""
    options = parser.parse_args()
    json_file, folder = (getattr(options, name, None) for name in ("json", "folder"))
    try:
        if json_file and (json_file.is_dir() or not json_file.resolve().parent.is_dir()):
            raise BadOption(f"--json {json_file} is not a file in a folder that exists")
        if folder:
            _make_folder(folder)
        main(options)
    except (BadOption, DeviceError, ImportError) as error:
        parser.error(" ".join(str(error).split()))


def _make_folder(folder):
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadOption(f"--folder {folder}: {error.strerror}") from error


def on_one_thread():
    """Start this command anew with one thread for each side, unless it was started so.

    NumPy's and FFT libraries read their variables when they are loaded.  PoCL's simplest device
    runs kernels in the calling thread: "basic", called "cpu-minimal" from version 4 on.  GalSim
    draws on one thread unless told otherwise.

    returns the variables, for the record
    """
    pocl = re.search(r"pocl (\d+)", get_device().cl.platform.version, re.IGNORECASE)
    wanted = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "POCL_DEVICES": "basic" if pocl is None or int(pocl[1]) < 4 else "cpu-minimal",
        "CL_CONFIG_CPU_TBB_NUM_WORKERS": "1",  # Intel's CPU runtime
    }
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        command = [sys.executable, *sys.orig_argv[1:]]
        os.execve(sys.executable, command, {**os.environ, **wanted})
    return " ".join(f"{name}={value}" for name, value in wanted.items())


def in_processes(function, tasks, n_processes):
    """Pairs (task, function(*task)) in the order in which other processes finish them."""
    pool = ProcessPoolExecutor(n_processes, mp_context=get_context("spawn"))
    try:
        futures = {pool.submit(function, *task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def interleaved_ms(functions, *, seconds, least=5):
    """Median time [ms] of one call of each function, all called in turn for `seconds`.

    functions: name -> callable.  Each is called before, to compile and allocate.  In a round the
    fast ones are called several times; what disturbs the machine disturbs them all alike.
    """
    for function in functions.values():
        function()
    once = {name: _seconds(function) for name, function in functions.items()}
    slowest = max(once.values())
    times = {name: [] for name in functions}
    end = time.perf_counter() + seconds
    while min(map(len, times.values())) < least or time.perf_counter() < end:
        for name, function in functions.items():
            for _ in range(max(1, min(MAX_REPEATS, int(slowest / once[name])))):
                times[name].append(_seconds(function))
    return {name: float(np.median(t)) * 1e3 for name, t in times.items()}


def _seconds(function):
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def surveys(printed):
    """Survey parameters by name: those of the paper's table, or those of its notebooks."""
    return PAPER_SURVEYS if printed else NOTEBOOK_SURVEYS


def record(threads):
    """Where and when: device, versions, date, and how each side was held to one thread."""
    device = get_device()
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "device": device.name,
        "platform": f"{device.platform}, {device.cl.platform.version}",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        "load": f"{os.getloadavg()[0]:.1f} processes wanted a core, mean of the last minute",
        "python": platform.python_version(),
        "clresample": __version__,
        **{name: version(name) for name in ("numpy", "pyopencl", "galsim")},
        "threads": threads,
    }


def print_head(columns):
    """Names of a table's columns, each (field, width, format of numbers)."""
    print("  ".join(name.rjust(width) for name, width, _ in columns), flush=True)


def print_row(columns, row):
    """One line of the table; what is not a number is printed as it is."""
    cells = []
    for name, width, form in columns:
        is_number = isinstance(row[name], (int, float))
        cells.append((format(row[name], form) if is_number else str(row[name])).rjust(width))
    print("  ".join(cells), flush=True)


def print_record(record):
    for name, value in record.items():
        print(f"{name}: {value}")


def print_summary(summary):
    """Groups of figures, one on each line; see `summarise` of a benchmark."""
    for group, figures in summary.items():
        print(f"{group}:")
        for name, value in figures.items():
            print(f"  {name}: {value:.3f}" if isinstance(value, float) else f"  {name}: {value}")


def write_json(path, content):
    """Write JSON whole or not at all; infinite and undefined numbers become null."""
    write_text(path, json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


def write_text(path, text):
    """Write a file whole or not at all."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


class Log:
    """What a run has found so far, one line of JSON for each part; it goes on where it ended.

    path: the file
    settings: what all parts of it share; a file of another run is refused in one line
    done: parts by their keys; a part appended twice counts as it was the last time
    """

    def __init__(self, path, settings):
        self.path, self.done = path, {}
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        if len(whole) < len(text):  # the run ended in the middle of a line
            os.truncate(path, len(whole))
        if not whole:
            self._append(settings)
            return
        found, *parts = map(json.loads, whole.splitlines())
        for name, value in settings.items():
            if found.get(name) != value:
                raise BadOption(
                    f"{path} comes from a run with {name} {found.get(name)}, not {value}: "
                    "remove it or name another --folder"
                )
        for key, part in parts:
            self.done[tuple(key)] = part

    def append(self, key, part):
        """Keep a part, `key` being a tuple of strings and numbers; interruptions leave it whole."""
        self._append([key, part])
        self.done[key] = part

    def _append(self, content):
        line = json.dumps(_finite(content), allow_nan=False) + "\n"
        with self.path.open("ab", buffering=0) as file:
            file.write(line.encode())


def _finite(value):
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
