"""Killed again and again: whether a field ends with the same catalogue whatever dies on the way.

    python -m bench.soak [--times N] [--json FILE]

A small simulated field is run once undisturbed. Then, each time in a new folder, the command or one
of its workers is killed (SIGKILL) at a random moment; a run that was killed is resumed, and killed
again with one chance in two. At the end its catalogue must be the undisturbed one, byte for byte.

killed     what: "run" or "worker"; at: part of the undisturbed run's time; kills: how many
same       whether the catalogue is the same; parts: groups of fits that were on disk at the kill
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from clresample import simulate_field
from clresample.cli.simulate import write_field

from .harness import records
from .harness.clock import on_all_cores
from .harness.options import ROOT, Parser, positive, run, seed

TIMES = 30
SIZE, DENSITY = 192, 120  # [px, arcmin^-2]: some ten sources, in fits of several sizes
LOOK_S = 0.02
COLUMNS = (("what", 6, ""), ("at", 5, ".2f"), ("kills", 5, "d"), ("parts", 5, "d"), ("same", 5, ""))


def start(sky, out, *options):
    """The command, begun."""
    words = [sys.executable, "-m", "clresample.cli", "field", sky / "field.toml", "-o", out]
    words += ["--workers", 2, "--quiet", *options]
    return subprocess.Popen(
        [str(word) for word in words],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def children(pid):
    """Processes that a process has started and that live."""
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(one) for one in path.read_text().split()] if path.exists() else []


def kill_at(process, seconds, what, rng):
    """Kill the process, or one of its children, after so many seconds; whether there was one."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None:
        time.sleep(LOOK_S)
    if process.poll() is not None:
        return False
    victims = [process.pid] if what == "run" else children(process.pid)
    if not victims:
        return False
    try:
        os.kill(rng.choice(victims), signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def disturbed(sky, out, expected, took_s, what, rng):
    """One row: a run that is killed at random, or has its workers killed, and ends."""
    at = rng.random()
    process, kills = start(sky, out), 0
    kills += kill_at(process, at * took_s, what, rng)
    parts = len(list((out / "work").glob("fit-*.fits")))
    status = process.wait()
    while status != 0:
        if status != -signal.SIGKILL:
            raise RuntimeError(f"exit status {status} after {kills} kills of a {what}")
        begun = (out / "work" / "run.json").exists()
        process = start(sky, out, *(["--resume"] if begun else []))
        if rng.random() < 0.5:
            kills += kill_at(process, rng.random() * took_s, "run", rng)
        status = process.wait()
    same = (out / "catalogue.fits").read_bytes() == expected
    return {"what": what, "at": at, "kills": kills, "parts": parts, "same": same}


def soak(times, seed_of_kills):
    """Rows of so many runs: whole runs and single workers are killed by turns."""
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


def main(options):
    threads = on_all_cores()
    record = records.record(threads) | {"kills": f"seed {options.seed}, {options.times} runs"}
    records.print_record(record)
    records.print_head(COLUMNS)
    rows = []
    for row in soak(options.times, options.seed):
        rows.append(row)
        records.print_row(COLUMNS, row)
    if options.json is not None:
        records.write_json(options.json, {"record": record, "rows": rows})
    differ = sum(not row["same"] for row in rows)
    print(f"{len(rows)} runs, {sum(row['kills'] for row in rows)} kills, {differ} differ")
    if differ:
        sys.exit(1)


def parser():
    parser = Parser("bench.soak", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--times", type=positive(int), default=TIMES, metavar="N", help="runs (%(default)s)"
    )
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="S", help="of the kills (%(default)s)"
    )
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
