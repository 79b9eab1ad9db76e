"""Killed, starved, cut off: whether a field ends with the same catalogue whatever happens.

    python -m bench.soak [--times N] [--json FILE]

A small simulated field is run once undisturbed. Then, each time in a new folder, the command or one
of its workers is killed (SIGKILL) at a random moment; a run that was killed is resumed, and killed
again with one chance in two. Five more runs follow, see bench/faults.py. At the end the catalogue
must be the undisturbed one, byte for byte, or what `good` says of a run that must differ.

what       "run" or "worker": what was killed; "disk", "tile", "memory", "write", "hang": see
           bench/faults.py
at         when, as part of the undisturbed run's time
kills      how often it was killed, or was ended by what it met
parts      groups of fits that were on disk when that came
same, good whether the catalogue is the same, and whether all is as it must be; about: what was seen
"""

from __future__ import annotations

import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from clresample import simulate_field
from clresample.cli.simulate import write_field

from .faults import FAULTS, kill_at, parts_in, start, told
from .harness import records
from .harness.clock import on_all_cores
from .harness.options import Parser, run, seed

TIMES = 30
SIZE, DENSITY = 192, 120  # [px, arcmin^-2]: some ten sources, in fits of several sizes
COLUMNS = (
    ("what", 6, ""),
    ("at", 5, ".2f"),
    ("kills", 5, "d"),
    ("parts", 5, "d"),
    ("same", 5, ""),
    ("good", 5, ""),
    ("about", 40, ""),
)


def disturbed(sky, out, expected, took_s, what, rng):
    """One row: a run that is killed at random, or has its workers killed, and ends."""
    at = rng.random()
    process, kills = start(sky, out), 0
    kills += kill_at(process, at * took_s, what, rng)
    parts = parts_in(out)
    status = process.wait()
    while status != 0:
        if status != -signal.SIGKILL:
            said = told(process)
            raise RuntimeError(f"exit status {status} after {kills} kills of a {what}: {said}")
        process = start(sky, out)
        if rng.random() < 0.5:
            kills += kill_at(process, rng.random() * took_s, "run", rng)
        status = process.wait()
    same = (out / "catalogue.fits").read_bytes() == expected
    row = {"what": what, "at": at, "kills": kills, "parts": parts}
    return row | {"same": same, "good": same, "about": ""}


def soak(times, seed_of_kills, faults=tuple(FAULTS)):
    """Rows of so many runs that are killed, whole runs and single workers by turns; then faults."""
    with tempfile.TemporaryDirectory() as folder:
        sky, folder = Path(folder) / "sky", Path(folder)
        given = {"rubin_bands": ("i",), "clustering": 0.4, "psf_variation": 0.1}
        write_field(sky, simulate_field(1, n_pixels=SIZE, density=DENSITY, **given))
        began = time.monotonic()
        if start(sky, folder / "whole").wait() != 0:
            raise RuntimeError("the undisturbed run failed")
        took_s = time.monotonic() - began
        expected = (folder / "whole" / "catalogue.fits").read_bytes()
        for i in range(times):
            what, rng = ("run", "worker")[i % 2], random.Random(f"{seed_of_kills} {i}")
            yield disturbed(sky, folder / f"out{i}", expected, took_s, what, rng)
        for what in faults:
            yield {"what": what} | FAULTS[what](sky, folder / what, folder / "whole", took_s)


def main(options):
    threads = on_all_cores()
    record = records.record(threads) | {"kills": f"seed {options.seed}, {options.times} runs"}
    found = soak(options.times, options.seed)
    rows, bad = records.judged(COLUMNS, found, record, options.json)
    print(f"{len(rows)} runs, {sum(row['kills'] for row in rows)} kills, {bad} not as they must be")
    if bad:
        sys.exit(1)


def parser():
    parser = Parser("bench.soak", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--times", type=seed, default=TIMES, metavar="N", help="runs that are killed (%(default)s)"
    )
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="S", help="of the kills (%(default)s)"
    )
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
