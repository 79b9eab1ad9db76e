"""Kills every command while it writes: outputs must be whole, as a set, and can be redone.

Each command is run undisturbed, into an empty place and over files that are there (--overwrite);
then killed so many times in each way, spread over all that it does in its folder, see dying.py:
with SIGKILL as it opens, moves, links or removes something, and by turns inside a file.

command    what was run; over: over files that were there
moment     what it was about to do, or how many bytes of which file were written
left       what was there afterwards, once the next run had looked: "old" or "new" outputs, or none
good       all of these hold: no file was cut short or mixed at any time; the outputs are all old,
           all new or all absent; run again, the command ends with the new ones, and clears away
           what the killed run has left
"""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from clresample.files.atomic import check_folder

from ..harness import records
from ..harness.options import ROOT

TIMES = 4
MAX_BYTES = 600  # of a file that is cut short: less than any output has
COLUMNS = records.columns("command:8 over:5 moment:58 left:6 good:5")
OLD = b"what was there before\n"
# what differs from one run to the next: times in headers, tables and JSON
TIMES = "DATE", "CHECKSUM", "DATASUM", "written", "seconds"
KILLED = {-signal.SIGKILL, -signal.SIGXFSZ}


def commands(base):
    """{name: words after `clresample`} of all that write; OUT stands for the folder."""
    scene, sky = base / "scene" / "scene.toml", base / "sky" / "field.toml"
    euclid, rubin = (base / "scene" / f"{name}.fits" for name in ("euclid", "rubin"))
    resample = [euclid, "--psf", base / "scene" / "euclid_psf.fits", "--like", rubin]
    resample += ["--psf-like", base / "scene" / "rubin_psf.fits", "--psf-like-band", "i"]
    simulate = ["simulate", "field", "-o", "OUT", "--size", 96, "--bands", "i"]
    run = base / "run"
    return {
        "example": ["deblend", "--example", "OUT"],
        "deblend": ["deblend", scene, "-o", "OUT", "--max-iter", 2, "--quiet"],
        "resample": ["resample", *resample, "-o", "OUT/a.fits", "--plot", "OUT/a.png"],
        "plain": simulate,
        "survey": [*simulate, "--format", "survey"],
        "field": ["field", sky, "-o", "OUT", "--workers", 0, "--quiet"],
        "report": ["report", run, "-o", "OUT/report.html"],
        "cutout": ["cutout", run, "--ids-from", run / "catalogue.fits", "-o", "OUT/cut.fits"],
    }


NAMES = tuple(commands(Path()))


def prepare(base, names):
    """The inputs of these commands."""
    after = {"report", "cutout"}
    needs = {"scene": {"deblend", "resample"}, "sky": {"field", *after}, "run": after}
    made = {
        "scene": ["deblend", "--example", base / "scene"],
        "sky": ["simulate", "field", "-o", base / "sky", *["--size", "96", "--bands", "i"]],
        "run": ["field", base / "sky" / "field.toml", "-o", base / "run", "--workers", 0],
    }
    for what, words in made.items():
        if needs[what].intersection(names):
            status, said = ended(base / "log", base, 0, 0, words)
            if status:
                raise RuntimeError(f"{what}: exit status {status}: {said}")


def ended(log, out, moment, n_bytes, words):
    """(exit status, standard error) of the command, which dies at a moment unless that is 0."""
    given = [str(word).replace("OUT", str(out)) for word in words]
    done = subprocess.run(
        [sys.executable, "-m", "bench.kills.dying", log, out.parent, *map(str, (moment, n_bytes))]
        + given,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr.strip()[-300:]


def content(path):
    """Content of a file without its times; its bytes if it cannot be read as its name promises."""
    try:
        if path.suffix == ".fits":
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of a file that was cut short, of a checksum
                with fits.open(path, checksum=True, memmap=False) as hdus:
                    return [_hdu(hdu) for hdu in hdus]
        if path.suffix == ".json":
            return {k: v for k, v in json.loads(path.read_text()).items() if k not in TIMES}
        if path.name == "fit_table.ecsv":
            table = Table.read(path)
            return repr(list(table[[c for c in table.colnames if c not in TIMES]]))
        if path.suffix == ".html":
            text = path.read_text()
            return text[:300], text[-300:]  # times are written in its middle
    except Exception:  # astropy's and NumPy's of a damaged file are of any kind
        pass
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _hdu(hdu):
    cards = [(k, v) for k, v in hdu.header.items() if k not in TIMES]
    data = hdu.data
    if hdu.name == "ABOUT":
        data = data[~np.isin(data["key"], TIMES)]
    return repr(cards), data is not None and hashlib.sha256(data.tobytes()).hexdigest()


def outputs(out):
    """{name: content} of the files in a folder, without those of a field's work."""
    found = {}
    for path in sorted(out.rglob("*")):
        inside = path.relative_to(out)
        hidden = any(part.startswith((".part-", ".done-")) for part in inside.parts)
        if path.is_file() and not hidden and inside.parts[0] != "work":
            found[str(inside)] = content(path)
    return found


def broken(work):
    """Names of the files of a field's work that cannot be read whole."""
    found = []
    for path in work.glob("*"):
        try:
            if path.suffix in (".npy", ".npz"):
                np.load(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".fits":
                with fits.open(path, memmap=False) as hdus:
                    for hdu in hdus:
                        hdu.verify("exception")
                        assert hdu.data is None or len(hdu.data) >= 0
        except Exception as error:
            found.append(f"{path.name}: {error}")
    return found


class Way:
    """A command in one state of its folder: new, or over files that are there.

    new: what it leaves undisturbed; moments: lines of the log of what it does; again: words of
    the next run, which goes on with a field
    """

    def __init__(self, name, words, folder, over):
        self.name, self.over, self.folder = name, over, folder
        self.out, self.words = folder / "out", words
        self.again = [*words, "--resume" if name == "field" and not over else "--overwrite"]
        self.names: list[str] = []
        if over:
            self.words = self.again
            ended(folder / "log", self.out, 0, 0, words)
            self.names = list(outputs(self.out))
        self.fresh()
        log = folder / "moments"
        status, said = ended(log, self.out, 0, 0, self.words)
        if status:
            raise RuntimeError(f"{name}, undisturbed: exit status {status}: {said}")
        self.new, self.moments = outputs(self.out), log.read_text().splitlines()

    def fresh(self):
        """The folder as it is before the command."""
        shutil.rmtree(self.out, ignore_errors=True)
        if self.name in ("resample", "report", "cutout") or self.over:
            self.out.mkdir(parents=True)
        for name in self.names:
            (self.out / name).parent.mkdir(parents=True, exist_ok=True)
            (self.out / name).write_bytes(OLD)
        if self.over and self.name == "field":
            (self.out / "work").mkdir()
            (self.out / "work" / "run.json").write_text("{}")
        self.old = outputs(self.out)

    def killed(self, moment, n_bytes):
        """The row of one run that dies at a moment (from 1); None where it has ended before."""
        self.fresh()
        status, _ = ended(self.folder / "log", self.out, moment, n_bytes, self.words)
        if status not in KILLED:
            return None
        here = outputs(self.out) if self.out.exists() else {}
        mixed = [n for n, what in here.items() if what not in (self.old.get(n), self.new.get(n))]
        mixed += broken(self.out / "work")
        check_folder(self.out)  # as the next run looks
        check_folder(self.out.parent)
        found = outputs(self.out) if self.out.exists() else {}
        whole = {"none": {}, "old": self.old, "new": self.new}
        left = next((what for what, those in whole.items() if found == those), "mixed")
        status, said = ended(self.folder / "log", self.out, 0, 0, self.again)
        redone = status == 0 and outputs(self.out) == self.new
        rest = [p for p in self.folder.rglob("*") if p.name.startswith((".part-", ".done-"))]
        about = f"{n_bytes} B after " if n_bytes else ""
        row = {"command": self.name, "over": self.over, "left": left}
        row["moment"] = f"{about}{_short(self.moments[moment - 1])}"
        row["good"] = not mixed and left != "mixed" and redone and not rest
        if not row["good"]:
            row["about"] = {
                "mixed": mixed,
                "status": status,
                "said": said,
                "rest": list(map(str, rest)),
            }
        return row


def _short(line):
    """A line of the log without the letters and numbers that make a name unique."""
    words = line.replace("/", " ").split()
    return " ".join(w.split("-")[0] if w.startswith((".part-", ".done-")) else w for w in words)


def moments_of(way, n, rng):
    """n pairs (moment, bytes): spread over all that is done, by turns in the midst of a file."""
    total, found = len(way.moments), []
    opens = [i + 1 for i, line in enumerate(way.moments) if line.startswith("open ")]
    for i in range(n):
        if i % 2 and opens:
            found.append((opens[int((i + rng.random()) / n * len(opens)) % len(opens)],
                          rng.randint(1, MAX_BYTES)))  # fmt: skip
        else:
            found.append((1 + int((i + rng.random()) / n * total), 0))
    return found


def kills(times, seed, names):
    """Rows of all commands of these names, killed so many times in each way."""
    with tempfile.TemporaryDirectory() as scratch:
        base = Path(scratch)
        prepare(base, names)
        for name, words in commands(base).items():
            for over in (False, True) if name in names else ():
                folder = base / f"{name}-{over}"
                folder.mkdir()
                way, rng = Way(name, words, folder, over), random.Random(f"{seed} {name}")
                for moment, n_bytes in moments_of(way, times, rng):
                    row = way.killed(moment, n_bytes)
                    if row is not None:
                        yield row
