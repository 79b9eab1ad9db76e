"""Kills, starves and damages runs of fields: all must end with the same catalogue.

A small simulated field is run once undisturbed. Then, each time in a new folder, the command or one
of its workers is killed (SIGKILL) at a random moment; a run that was killed is resumed, and killed
again with one chance in two. At the end the catalogue must be the undisturbed one, byte for byte.
Five more runs follow:

disk       the output folder is a small file system of its own, which fills up; each time it gets
           twice the room, and the run goes on. Where none may be mounted, no file may be larger
           than so much instead. The catalogue must be the same
tile       one tile of Euclid's compressed image is damaged; the run is killed once as well. Sources
           away from it must be those of the undisturbed run, fluxes within NEAR of their errors;
           every source on it must have a reason, or its tile of the search be reported
memory     the device has a tenth of this machine's memory, and a worker process a gigabyte at most.
           Fits share other batches then: the same sources, their fluxes within NEAR of its errors
write      the run is killed whenever one more of its files is being written, until WRITES of them
           were left unfinished. The catalogue must be the same
hang       a worker is stopped (SIGSTOP) and never goes on. The catalogue must be the same

Columns:

what       "run" or "worker": what was killed; or one of these faults
at         when, as part of the undisturbed run's time
kills      how often it was killed, or was ended by what it met
parts      groups of fits that were on disk when that came
same, good whether the catalogue is the same, and whether all is as it must be; about: what was seen
"""

from __future__ import annotations

import functools
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable

from clresample import simulate_field
from clresample.cli.simulate import write_field

from ..harness import records
from ..harness.memory import children
from ..harness.options import ROOT

TIMES, WORKERS = 30, 2
SIZE, DENSITY = 192, 120  # [px, arcmin^-2]: some ten sources, in fits of several sizes
COLUMNS = records.columns("what:6 at:5.2f kills:5d parts:5d same:5 good:5 about:40")

LOOK_S = 0.02
NEAR = 0.1  # [errors] of a flux: what batches of other sizes change is under a hundredth
FIRST_ROOM = 512 << 10  # [bytes] of the file system that fills up
WRITES = 5  # unfinished files, each of which the next run must clear away
SOON_S = 1e-3  # [s] between two looks for a file that is being written, which takes some ms
HANGS_S = 30.0  # [s] after which a worker is taken to hang
SMALL = {"POCL_MEMORY_LIMIT": str(max(1, os.sysconf("SC_PHYS_PAGES") * 4096 // 10 >> 30))}
# [px] A field of six compressed tiles of Euclid's image, of which the last is damaged. The search's
# own tiles that reach there are lost, two rows of 64 px; what lies AWAY_PX from the damage is in no
# blend with what was lost.
TALL, AWAY_PX = 384, 144
TILES = "\n[field]\ntile_px = 64\noverlap_px = 16\n"


def start(sky, out, *options, workers=None, environment=None, before=None):
    """Starts the command; it resumes a run if the folder has one.

    Its standard error goes to a file, which `told` reads: a full pipe would block the process.
    """
    if (out / "work" / "run.json").exists():
        options = *options, "--resume"
    words = [sys.executable, "-m", "clresample.cli", "field", sky / "field.toml", "-o", out]
    words += ["--workers", WORKERS if workers is None else workers, "--quiet", *options]
    errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - read when the process has ended
    process = subprocess.Popen(
        [str(word) for word in words],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=errors,
        env={**os.environ, **(environment or {})},
        preexec_fn=before,
    )
    process.errors = errors
    return process


def told(process):
    """Text of a process of `start` on standard error, after its end."""
    process.wait()
    with process.errors as file:
        file.seek(0)
        return file.read().strip()


def parts_in(out):
    """Groups of fits that are on disk."""
    return len(list((out / "work").glob("fit-*.arrays")))


def kill_at(process, seconds, what, rng, number=signal.SIGKILL):
    """Sends a signal to the process, or to one of its children, after so many seconds.

    Returns False if there was none.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None:
        time.sleep(LOOK_S)
    if process.poll() is not None:
        return False
    victims = [process.pid] if what == "run" else children(process.pid)
    if not victims:
        return False
    try:
        os.kill(rng.choice(victims), number)
    except ProcessLookupError:
        return False
    return True


def same_bytes(out, whole):
    """True if two runs have the same catalogue, byte for byte."""
    return (out / "catalogue.fits").read_bytes() == (whole / "catalogue.fits").read_bytes()


def row_of(good, same, about, kills=0, parts=0, at=0.0):
    return {"at": at, "kills": kills, "parts": parts, "same": same, "good": good, "about": about}


def full_disk(sky, out, whole, took_s):
    """A run on a disk that is full again and again."""
    out.mkdir()
    mounted = _mount(out, FIRST_ROOM)
    room, n_full, parts = FIRST_ROOM, 0, []
    try:
        while True:
            before = None if mounted else functools.partial(_limit_files, room)
            process = start(sky, out, before=before)
            said = told(process)
            if process.returncode == 0:
                break
            if "cannot be written" not in said or process.returncode < 0:
                raise RuntimeError(f"exit status {process.returncode} on a full disk: {said}")
            n_full, room = n_full + 1, 2 * room
            parts.append(parts_in(out))
            if mounted:
                subprocess.run(["mount", "-o", f"remount,size={room}", str(out)], check=True)
        same = same_bytes(out, whole)
    finally:
        if mounted:
            subprocess.run(["umount", str(out)], check=False)
    how = "file system" if mounted else "no mount allowed: files"
    about = f"{how} of up to {room >> 10} KiB"
    return row_of(same and n_full > 0, same, about, n_full, max(parts, default=0))


def _mount(folder, room):
    """Mounts a file system of so many bytes on a folder; returns False if that fails."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={room}", "clresample-soak", str(folder)]
    try:
        return subprocess.run(words, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def _limit_files(room):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # an error of the write instead
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))


def damaged_tile(sky, out, whole, took_s):
    """A run over a field with one damaged tile of Euclid's image, killed once."""
    good, bad = out.with_name("good"), out.with_name("bad")
    for folder in (good, bad):
        given = {"rubin_bands": ("i",), "clustering": 0.4, "psf_variation": 0.1}
        write_field(folder, simulate_field(2, n_pixels=TALL, density=36, **given))
        with open(folder / "field.toml", "a") as file:
            file.write(TILES)
    first, _ = damage(bad / "euclid.fits")
    start(good, out.with_name("clean"), workers=0).wait()
    process = start(bad, out, workers=0)
    kills = kill_at(process, took_s * 0.6, "run", random.Random(0))
    process.wait()
    parts = parts_in(out)
    if kills:
        process = start(bad, out, workers=0)
        process.wait()
    rows, clean = (QTable.read(f / "catalogue.fits") for f in (out, out.with_name("clean")))
    lost = json.loads((out / "provenance.json").read_text())["failed_tiles"]
    failed = np.array([str(s) == "failed" for s in rows["status"]], bool)
    named = all("euclid.fits" in str(r) for r in [*rows["reason"][failed], *lost.values()])
    away = clean["y"].value < first - AWAY_PX
    missing, worst = compared(rows[~failed], clean[away])
    about = f"{len(lost)} tiles lost, {failed.sum()} of {len(rows)} sources failed, {missing} of "
    about += f"{away.sum()} away from it are missing, fluxes differ by {worst:.3f} errors"
    seen = process.returncode == 1 and named and bool(len(lost) or failed.any()) and away.any()
    return row_of(
        bool(seen and missing == 0 and worst < NEAR), False, about, int(kills), parts, 0.6
    )


def damage(path):
    """Overwrites the last tile of a compressed image; returns its first row and height [px]."""
    with fits.open(path, disable_image_compression=True) as hdus:
        header, begin = hdus["SCI"].header, hdus["SCI"].fileinfo()["datLoc"]
        n_rows, n_all = header["ZTILE2"], header["ZNAXIS2"]
        n_row_bytes, n_tiles = header["NAXIS1"], header["NAXIS2"]
    # COMPRESSED_DATA is the first column: length and place in the heap of each tile, as 1PB or 1QB
    wide = "Q" in header["TFORM1"]
    with open(path, "r+b") as file:
        file.seek(begin + (n_tiles - 1) * n_row_bytes)
        size = 16 if wide else 8
        length, offset = np.frombuffer(file.read(size), ">i8" if wide else ">i4").tolist()
        file.seek(begin + header.get("THEAP", n_tiles * n_row_bytes) + offset)
        file.write(b"\xff" * length)
    first = (n_all - 1) // n_rows * n_rows
    return first, n_all - first


def compared(rows, clean):
    """Number of sources missing in `rows`, and the largest change of a flux [errors]."""
    shared, i, j = np.intersect1d(rows["id"], clean["id"], return_indices=True)
    worst = 0.0
    for name in [c for c in clean.colnames if c.startswith("flux_err_")]:
        flux = name.replace("_err", "")
        change = np.abs(rows[flux][i].value - clean[flux][j].value) / clean[name][j].value
        worst = max(worst, float(np.nanmax(change, initial=0.0)))
    return len(clean) - len(shared), worst


def small_device(sky, out, whole, took_s):
    """A run on a device with a tenth of the memory, its processes held to a gigabyte."""
    process = start(sky, out, "--worker-memory", "1G", environment=SMALL)
    said = told(process)
    if process.returncode != 0:
        return row_of(False, False, f"exit status {process.returncode}: {said.strip()[-80:]}")
    rows, clean = (QTable.read(f / "catalogue.fits") for f in (out, whole))
    missing, worst = compared(rows, clean)
    about = f"{missing} missing, fluxes differ by {worst:.3f} errors"
    good = missing == 0 and len(rows) == len(clean) and worst < NEAR
    return row_of(good, same_bytes(out, whole), about)


def unfinished(out):
    """True while a run writes a file, and if a killed run has left one unfinished."""
    return any((out / "work").glob(".part-*"))


def finished(out):
    """Files of a run that are whole."""
    return sum(path.is_file() for path in (out / "work").glob("*"))


def killed_writing(sky, out, whole, took_s):
    """A run that is killed while it writes, again and again."""
    process, kills, left, parts, whole_files = start(sky, out), 0, 0, 0, 0
    while process.poll() is None:
        if left < WRITES and unfinished(out) and finished(out) > whole_files:
            process.kill()
            process.wait()
            kills, left = kills + 1, left + unfinished(out)
            parts, whole_files = parts_in(out), finished(out)
            process = start(sky, out)
        time.sleep(SOON_S)
    if process.returncode != 0:
        said = told(process)
        return row_of(False, False, f"exit status {process.returncode}: {said[-80:]}", kills)
    same = same_bytes(out, whole)
    about = f"{left} files were left unfinished"
    good = same and left > 0 and not unfinished(out)
    return row_of(good, same, about, kills, parts)


def hanging(sky, out, whole, took_s):
    """A run one of whose workers stops and never goes on."""
    process = start(sky, out, "--timeout", max(HANGS_S, 2 * took_s))
    stopped = kill_at(process, 0.5 * took_s, "worker", random.Random(0), signal.SIGSTOP)
    parts = parts_in(out)
    process.wait()
    same = process.returncode == 0 and same_bytes(out, whole)
    about = "one worker stopped" if stopped else "the run had ended before a worker was stopped"
    return row_of(same, same, about, int(stopped), parts, 0.5)


FAULTS = {
    "disk": full_disk,
    "tile": damaged_tile,
    "memory": small_device,
    "write": killed_writing,
    "hang": hanging,
}


def disturbed(sky, out, whole, took_s, what, rng):
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
    same = same_bytes(out, whole)
    return {"what": what} | row_of(same, same, "", kills, parts, at)


def soak(times, seed, faults):
    """Rows of so many runs that are killed, single workers and whole runs by turns; then faults."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        sky, whole = folder / "sky", folder / "whole"
        given = {"rubin_bands": ("i",), "clustering": 0.4, "psf_variation": 0.1}
        write_field(sky, simulate_field(1, n_pixels=SIZE, density=DENSITY, **given))
        began = time.monotonic()
        if start(sky, whole).wait() != 0:
            raise RuntimeError("the undisturbed run failed")
        took_s = time.monotonic() - began
        for i in range(times):
            what, rng = ("worker", "run")[i % 2], random.Random(f"{seed} {i}")
            yield disturbed(sky, folder / f"out{i}", whole, took_s, what, rng)
        for what in faults:
            yield {"what": what} | FAULTS[what](sky, folder / what, whole, took_s)
