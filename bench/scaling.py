"""Time, memory and own cost of a field against the number of workers, and of one giant blend.

    python -m bench.scaling [--quick] [--json FILE]
    python -m bench.scaling --giant 1500 --sizes 3000 --workers 2

The same simulated field, its files on disk, is run by `run_field` with each number of workers in
turn, several times (--repeats). Each worker has one core: PoCL uses one thread in it. At the end
the median speed-ups of the turns are printed. The search is distributed by tiles of 1024 pixels,
so that smaller fields have less speed-up than a survey's. With --giant the field is the core of a
cluster of galaxies: so many sources, at known positions, under a smooth halo that joins all of
their light to one blend, which is cut into pieces. The fitted sky absorbs the halo.

wall_s, fit_s       of the run, and of its fits alone
core_s              processor time of all processes; per source in core_s_per_source
speed_up, fit_speed wall time with the fewest workers over that with these; of the fits alone
own_cost            processor time of the process that distributes the work while others search
                    and fit, over that of all of them
busy                time that workers spent in fits over workers times the fits' wall time
tail_s              from the first worker without a task left to the end of the fits, all rounds
peak_gb, largest_gb memory of all processes at once, and of the largest alone; pages that several
                    share are counted once in all
n_blends, pieces    of the plan; measured: sources with a finite flux in every channel
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from astropy.table import QTable

from clresample import FieldOptions, Settings, simulate_field
from clresample.cli.simulate import write_field
from clresample.fields.field_toml.field_file import read_field
from clresample.fields.options import RunProgress
from clresample.fields.run import run_field

from .harness import records
from .harness.clock import on_all_cores
from .harness.memory import TreeMemory
from .harness.options import Parser, run

SIZES, QUICK_SIZES, GIANT_SIZES = (2048,), (256,), (3000,)
REPEATS = 3  # of a field; a giant, and with --quick, once
BANDS, QUICK_BANDS = "ugrizy", "ri"
MIN_SNR = 5.0  # of sources whose places are given
# Euclid's signal to noise of the halo's light in one pixel, in the corners: 28.7 mag per square
# arcsecond, 26.8 in the middle, as light between galaxies has it. In the search's filtered sum of
# all instruments that is over the limit everywhere. Its core is a rich cluster's at redshift 0.3:
# in a piece the halo is nearly flat, which the fitted sky takes up; in 3000 pixels it falls to a
# fifth.
HALO_SIGMA, CORE_ARCSEC = 0.1, 100.0
COLUMNS = records.columns(
    "n_model:7d workers:7d n_sources:9d measured:8d n_blends:8d pieces:6d wall_s:7.1f "
    "fit_s:7.1f core_s_per_source:17.3f speed_up:8.2f fit_speed:9.2f own_cost:8.4f busy:5.2f "
    "tail_s:6.1f peak_gb:7.2f largest_gb:10.2f status:20"
)


class Stages(RunProgress):
    """Processor time [s] of this process when each stage began, without that of the TreeMemory."""

    def __init__(self, memory):
        self.memory, self.began = memory, {}

    def stage(self, name, total):
        self.began.setdefault(name, time.process_time() - self.memory.spent_s)


def halo_of(mosaic, n_pixels, survey_of_noise):
    """Counts (C, Ny, Nx) of a halo about a field's middle, of one brightness in AB magnitudes.

    survey_of_noise: in whose pixels HALO_SIGMA is meant
    """
    finest = survey_of_noise.pixel_scale_arcsec
    corner = np.hypot(n_pixels, n_pixels) / 2 * finest
    y, x = np.indices(mosaic.grid.shape) - np.array(mosaic.grid.shape).reshape(2, 1, 1) / 2
    radius = np.hypot(y, x) * mosaic.survey.pixel_scale_arcsec
    shape = (1 + (corner / CORE_ARCSEC) ** 2) / (1 + (radius / CORE_ARCSEC) ** 2)
    unit = float(survey_of_noise.counts(np.zeros((1, 1)))[0, 0])
    magnitude = -2.5 * np.log10(HALO_SIGMA * survey_of_noise.noise_sigma[0] / unit)
    area = (mosaic.survey.pixel_scale_arcsec / finest) ** 2
    counts = mosaic.survey.counts(np.full((1, mosaic.survey.n_bands), magnitude))[0]
    return area * counts[:, None, None] * shape


def written(folder, size, options, bands):
    """field.toml of a simulated field, and its FieldOptions beyond workers."""
    given = {"rubin_bands": bands, "psf_variation": 0.1, "bad_columns": 2}
    if options.giant is None:
        field = simulate_field(options.seed, n_pixels=size, density=options.density, **given)
        return write_field(folder, field)[0], {}
    arcmin2 = (size * 0.1 / 60) ** 2
    density = 1.1 * options.giant / arcmin2  # the faintest are left out
    field = simulate_field(
        options.seed, n_pixels=size, density=density, faintest=25.0, clustering=0.4, **given
    )
    for mosaic in field.mosaics:
        mosaic.data[:] += halo_of(mosaic, size, field.mosaics[0].survey)
    brightest = np.argsort(-field.truth["snr"])[: options.giant]
    chosen = brightest[field.truth["snr"][brightest] > MIN_SNR]
    places = np.stack([field.truth["ra"], field.truth["dec"]], axis=1)[chosen]
    own = {"positions": places, "passes": 1, "settings": Settings(fit_sky=True)}
    return write_field(folder, field)[0], own


def row_of(toml, out, size, workers, own):
    """The row of one run, without what compares it with others."""
    field, memory = read_field(toml), TreeMemory(os.getpid())
    stages = Stages(memory)
    memory.start()
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    start = time.process_time()
    done = run_field(
        field.mosaics, out, options=FieldOptions(workers=workers, **own), progress=stages
    )
    wall_s, own_s = time.perf_counter() - began, time.process_time() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    memory.stop()
    own_s -= memory.spent_s
    theirs_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    dealing_s = stages.began["write"] - stages.began["fit"]
    table, blends = QTable.read(out / "catalogue.fits"), QTable.read(out / "fit_table.ecsv")
    fluxes = [np.asarray(table[c]) for c in table.colnames if c.startswith("flux_")]
    fluxes = [f for f in fluxes if f.dtype.kind == "f"]
    fit_s, turns = done.seconds["fit"], [o for stage, o in done.task_times if stage == "fit"]
    return {
        "n_model": size,
        "workers": workers,
        "n_sources": len(table),
        "measured": int(np.isfinite(fluxes).all(axis=0).sum()),
        "n_blends": len(set(blends["parent_id"].tolist())),
        "pieces": len(blends),
        "wall_s": wall_s,
        "fit_s": fit_s,
        "core_s": own_s + theirs_s,
        "core_s_per_source": (own_s + theirs_s) / max(len(table), 1),
        "own_cost": dealing_s / (dealing_s + theirs_s),
        "busy": sum(o.end_s - o.start_s for o in turns) / (workers * fit_s),
        "tail_s": tail_of(turns, workers),
        "peak_gb": memory.peak / 1e9,
        "largest_gb": memory.largest / 1e9,
        "stage": done.seconds,
        "status": ", ".join(f"{n} {how}" for how, n in sorted(done.outputs.status.items())),
    }


def tail_of(turns, workers):
    """Seconds from the first worker's last task to the last one's, of all rounds together."""
    rounds: dict[int, dict] = {}
    for outcome in turns:
        ends = rounds.setdefault(outcome.task.round, {})
        ends[outcome.worker] = max(ends.get(outcome.worker, 0.0), outcome.end_s)
    return sum(
        max(ends.values()) - min(ends.values()) for ends in rounds.values() if len(ends) == workers
    )


def rows_of(size, options, bands):
    """Yields the rows of one field, with each number of workers, as often as asked."""
    usual = 1 if options.quick or options.giant else REPEATS
    with tempfile.TemporaryDirectory() as folder:
        toml, own = written(Path(folder) / "sky", size, options, bands)
        for turn in range(options.repeats or usual):
            first = None
            for workers in sorted(options.workers):
                row = row_of(toml, Path(folder) / f"out{workers}-{turn}", size, workers, own)
                first = first or row
                row["speed_up"] = first["wall_s"] / row["wall_s"]
                row["fit_speed"] = first["fit_s"] / row["fit_s"]
                yield row


def medians(rows):
    """A line for each size and number of workers that ran several times: its median speed-ups."""
    found: dict[tuple, list] = {}
    for row in rows:
        found.setdefault((row["n_model"], row["workers"]), []).append(row)
    for (size, workers), several in found.items():
        if len(several) > 1:
            whole, fits = (median(r[key] for r in several) for key in ("speed_up", "fit_speed"))
            yield (
                f"{size} pixels, {workers} workers: median speed-up of {len(several)} turns "
                f"{whole:.2f}, of the fits {fits:.2f}"
            )


def main(options):
    one = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1"}
    os.environ.update(one)  # of the workers; this process runs nothing on a device
    threads = on_all_cores()
    bands = tuple(QUICK_BANDS if options.quick else BANDS)
    usual = GIANT_SIZES if options.giant else QUICK_SIZES if options.quick else SIZES
    what = f"{options.density:g} sources per square arcminute to i = 26"
    if options.giant:
        what = f"one blend of {options.giant} sources"
    record = records.record(f"{threads}, one thread a worker") | {
        "fields": f"seed {options.seed}, {what}, Euclid VIS and Rubin {''.join(bands)}"
    }
    rows = (row for size in options.sizes or usual for row in rows_of(size, options, bands))
    rows = records.show(COLUMNS, rows, record, options.json, below=records.print_stages)
    for line in medians(rows):
        print(line)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "256 pixels, two bands of Rubin, once")
    parser.add_number("repeats", f"turns of a field ({REPEATS})")
    parser.add_sizes(SIZES)
    parser.add_number("workers", "numbers of processes, by turns (1 2)", [1, 2], nargs="+")
    about = "one blend of so many sources instead of a field (3000 pixels a side)"
    parser.add_number("giant", about, metavar="S")
    parser.add_density()
    parser.add_seed(0, "of the field")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
