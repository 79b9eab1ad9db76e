"""Whole fields: simulated mosaics to a catalogue by the command, compared with the truth.

    python -m bench.field [--quick] [--json FILE]

A row is one field, run as a user does: simulated, written, `clresample field` in a process of its
own with workers.

n_truth, n_sources  sources with signal to noise over 5 in the truth, and rows of the catalogue;
                    signal to noise is that of the best possible filter over all channels
completeness        share found of those at 20 - 100 with no neighbour within 8 model pixels; a
                    source is found where a catalogue row within 4 pixels is its own
faint, bright       the same at 10 - 20, and over 100
close               share found of those over 20 that have a neighbour within 8 pixels
spurious            share of the rows within 5 pixels of nothing in the truth
flux_bias           median of (flux - truth) / truth of those found over 20 without neighbour, all
                    channels
pull_width          of theirs (flux - truth) / error: 1.4826 MAD
core_s_per_source   processor time of all processes over all rows
wall_s, peak_gb     of the command; the memory is that of its largest process
stage               seconds of wall time by stage
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.table import QTable

from clresample import simulate_field
from clresample.cli.simulate import write_field

from .harness import records
from .harness.clock import ONE_THREAD, on_all_cores
from .harness.options import ROOT, Parser, positive, run, seed

SIZES, QUICK_SIZES = (1024, 2048), (384,)
BANDS, QUICK_BANDS = "ugrizy", "ri"
NEAR_PX, FOUND_PX, NOTHING_PX = 8.0, 4.0, 5.0
EDGE_PX = 8  # sources so near to the edge are not judged: their light is not all there
COLUMNS = (
    ("n_model", 7, "d"),
    ("n_truth", 7, "d"),
    ("n_sources", 9, "d"),
    ("completeness", 12, ".3f"),
    ("faint", 6, ".3f"),
    ("bright", 6, ".3f"),
    ("close", 6, ".3f"),
    ("spurious", 8, ".3f"),
    ("flux_bias", 9, ".4f"),
    ("pull_width", 10, ".3f"),
    ("core_s_per_source", 17, ".3f"),
    ("wall_s", 7, ".1f"),
    ("peak_gb", 7, ".2f"),
    ("status", 20, ""),
)


def matched(positions, truth):
    """For each true position the row that is its own, within FOUND_PX, or -1.

    Pairs are taken in the order of their distance, each row and each true source once.
    """
    found = np.full(len(truth), -1)
    if not len(positions):
        return found
    apart = np.hypot(*(truth[:, None] - positions[None]).transpose(2, 0, 1))
    near = np.argwhere(apart < FOUND_PX)
    taken = set()
    for t, row in near[np.argsort(apart[tuple(near.T)], kind="stable")]:
        if found[t] < 0 and row not in taken:
            found[t] = row
            taken.add(row)
    return found


def compared(table, truth, channels, n_model):
    """Completeness, spurious share, bias and pulls of a catalogue beside the truth."""
    at = np.stack([table["y"].value, table["x"].value], axis=1)
    true = np.stack([truth["y"], truth["x"]], axis=1)

    def inner(places):
        return ((places > EDGE_PX) & (places < n_model - 1 - EDGE_PX)).all(axis=1)

    own, snr = matched(at, true), np.asarray(truth["snr"])
    apart = np.hypot(*(true[:, None] - true[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    # neighbours too faint to be seen do not count
    apart[:, snr < 5] = np.inf
    alone = apart.min(axis=1) > NEAR_PX

    def share(chosen):
        chosen = chosen & inner(true)
        return float((own[chosen] >= 0).mean()) if chosen.any() else float("nan")

    rows = at[inner(at)]
    nearest = np.array([np.hypot(*(true - row).T).min() for row in rows])
    judged = (own >= 0) & alone & (snr > 20) & inner(true)
    flux, error, expected = (
        np.concatenate(columns)
        for columns in zip(
            *(
                (
                    table[f"flux_{c}"].value[own[judged]],
                    table[f"flux_err_{c}"].value[own[judged]],
                    np.asarray(truth[f"flux_{c}"])[judged],
                )
                for c in channels
            ),
            strict=True,
        )
    )
    pulls = (flux - expected) / error
    pulls = pulls[np.isfinite(pulls)]
    return {
        "n_truth": int((snr > 5).sum()),
        "n_sources": len(table),
        "completeness": share(alone & (snr > 20) & (snr <= 100)),
        "faint": share(alone & (snr > 10) & (snr <= 20)),
        "bright": share(alone & (snr > 100)),
        "close": share(~alone & (snr > 20)),
        "spurious": float((nearest > NOTHING_PX).mean()) if len(rows) else float("nan"),
        "flux_bias": float(np.nanmedian((flux - expected) / expected)),
        "pull_width": float(1.4826 * np.median(np.abs(pulls - np.median(pulls)))),
    }


def row_of(size, options):
    """The row of one field."""
    bands = tuple(QUICK_BANDS if options.quick else BANDS)
    field = simulate_field(
        options.seed,
        n_pixels=size,
        density=options.density,
        rubin_bands=bands,
        psf_variation=0.1,
        bad_columns=2,
    )
    with tempfile.TemporaryDirectory() as folder:
        sky, out = Path(folder) / "sky", Path(folder) / "out"
        toml = write_field(sky, field)[0]
        command = [sys.executable, "-m", "clresample.cli", "field", toml, "-o", out, "--quiet"]
        command += ["--workers", options.workers]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [str(word) for word in command], cwd=ROOT, capture_output=True, text=True, check=False
        )
        wall_s = time.perf_counter() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode not in (0, 1):
            raise RuntimeError(done.stderr.strip() or f"exit status {done.returncode}")
        table = QTable.read(out / "catalogue.fits")
        about = json.loads((out / "provenance.json").read_text())
    core_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    fits = about["fits"]
    return compared(table, field.truth, ("VIS", *bands), size) | {
        "n_model": size,
        "core_s_per_source": core_s / max(len(table), 1),
        "wall_s": wall_s,
        "peak_gb": after.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9,
        "stage": about["seconds"],
        "status": ", ".join(f"{n} {how}" for how, n in sorted(fits.items())),
    }


def main(options):
    threads = on_all_cores()
    sizes = options.sizes or (QUICK_SIZES if options.quick else SIZES)
    record = records.record(threads) | {
        "fields": f"seed {options.seed}, {options.density:g} sources per square arcminute to "
        f"i = 26, Euclid VIS and Rubin {QUICK_BANDS if options.quick else BANDS} at 12 degrees",
        "workers": f"{options.workers}, {' '.join(ONE_THREAD)} = 1 each",
    }
    records.print_record(record)
    records.print_head(COLUMNS)
    rows = []
    for size in sizes:
        rows.append(row_of(size, options))
        records.print_row(COLUMNS, rows[-1])
        stages = rows[-1]["stage"].items()
        print("  " + ", ".join(f"{name} {s:.2f} s" for name, s in stages), flush=True)
    if options.json is not None:
        records.write_json(options.json, {"record": record, "rows": rows})


def parser():
    parser = Parser("bench.field", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="one field of 384 pixels, two bands of Rubin"
    )
    parser.add_sizes(SIZES)
    parser.add_argument(
        "--density",
        type=positive(float),
        default=36.0,
        metavar="N",
        help="sources per square arcminute (%(default)s)",
    )
    parser.add_argument(
        "--workers", type=positive(int), default=2, metavar="N", help="processes (%(default)s)"
    )
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="S", help="of the first field (%(default)s)"
    )
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
