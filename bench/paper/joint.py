"""Section 6 of the paper: galaxies of blended scenes, fitted to each survey and to both.

    python -m bench.paper.joint [--scenes N] [--folder FOLDER]

A scene holds 1 to 10 galaxies as in the paper's table.  Three modes: Rubin's six bands alone,
Euclid's alone, both together; all models live on Euclid's pixels, those of the truth.  Two starts:

own      nothing is known but the positions
sersic   as the paper does: each morphology starts from a Sersic profile fitted to its own truth

SDR [dB] is of a galaxy's model against its truth, both of unit sum.  A run continues where it was
interrupted; more scenes add to those that are there.
"""

from __future__ import annotations

import numpy as np

from clresample.deblending.batch import deblend_many
from clresample.deblending.settings import Settings

from ..harness import records, scenes
from ..harness.clock import in_chunks, in_processes, on_one_thread
from ..harness.options import Parser, run
from . import figures, report, sersic
from .joint_bins import SINGLES, bin_galaxies, summarise

STARTS = ("own", "sersic")
CHUNK = 8  # scenes fitted side by side and logged together: some seconds


def measure(folder, seeds):
    """Entry of the log for some scenes: magnitudes and SDRs of their galaxies, one list each.

    A mode's SDRs are null where its fit failed.
    """
    found = [scenes.opened(folder).take(seed) for seed in seeds]
    parts = [
        {
            "euclid_mag": np.round(scene.euclid.magnitudes.min(axis=1), 3).tolist(),
            "rubin_mag": np.round(scene.rubin.magnitudes.min(axis=1), 3).tolist(),
        }
        for scene in found
    ]
    for start in STARTS:
        profiles = [_profiles(scene) if start == "sersic" else None for scene in found]
        for mode in scenes.MODES:
            blends = [
                scenes.blend(scene, mode, profiles=given)
                for scene, given in zip(found, profiles, strict=True)
            ]
            for part, scene, result in zip(parts, found, deblend_many(blends), strict=True):
                failed = result.status == "failed"
                sdr = [None] * len(scene.profiles) if failed else scenes.scores(result, scene)
                part[f"{start}-{mode}"] = [None if s is None else round(s, 3) for s in sdr]
    return parts


def _profiles(scene):
    return [
        sersic.fit(truth, position)
        for truth, position in zip(scene.euclid.truth, scene.euclid.positions_px, strict=True)
    ]


def run_scenes(options, log):
    """Fits the scenes that the log lacks, in several processes, each on one thread."""
    missing = [seed for seed in range(options.scenes) if (seed,) not in log.done]
    tasks = [(options.catalogue, chunk) for chunk in in_chunks(missing, CHUNK)]
    there = options.scenes - len(missing)
    done = in_processes(measure, tasks, options.processes, lambda task: len(task[1]), there)
    for (_, seeds), parts in done:
        for seed, part in zip(seeds, parts, strict=True):
            log.append((seed,), part)


def collect(log):
    """Magnitudes and SDRs (n,) of all galaxies in the log, by name; without failed fits."""
    parts = [log.done[key] for key in sorted(log.done)]
    table = {name: np.array(sum((p[name] for p in parts), []), float) for name in parts[0]}
    whole = np.isfinite(list(table.values())).all(axis=0)
    return {name: values[whole] for name, values in table.items()}, int((~whole).sum())


def draw(folder, maps):
    """Draws sdr_per_mag and single_vs_joint, and the errors of the second, for each start."""
    edges = [f"{low:g}" for low in maps["edges"][:-1]]
    axes = {
        "rows": edges,
        "columns": edges,
        "row_label": "Euclid magnitude, from",
        "column_label": "brightest Rubin magnitude, from",
    }
    Map = figures.Map
    number = Map("galaxies", np.where(maps["number"], maps["number"], np.nan), ".0f")
    for start in STARTS:
        mean = {mode: maps["mean"][f"{start}-{mode}"] for mode in scenes.MODES}
        limits = tuple(f([f(m) for m in mean.values()]) for f in (np.nanmin, np.nanmax))
        titles = {"rubin": "Rubin alone", "euclid": "Euclid alone", "joint": "joint"}
        figures.heat_maps(
            folder / f"joint-sdr_per_mag-{start}.png",
            [Map(f"{titles[m]}, SDR [dB]", mean[m], limits=limits) for m in scenes.MODES],
            **axes,
        )
        gains = [maps["gain"][f"{start}-{m}"] for m in SINGLES]
        errors = [maps["error"][f"{start}-{m}"] for m in SINGLES]
        figures.heat_maps(
            folder / f"joint-single_vs_joint-{start}.png",
            [
                Map(f"joint minus {titles[m]} [dB]", gain, diverging=True)
                for m, gain in zip(SINGLES, gains, strict=True)
            ],
            **axes,
        )
        figures.heat_maps(
            folder / f"joint-errors-{start}.png",
            [
                *(
                    Map(f"its standard error, {titles[m]} [dB]", error, ".2f")
                    for m, error in zip(SINGLES, errors, strict=True)
                ),
                number,
            ],
            **axes,
        )


def main(options):
    sky = scenes.opened(options.catalogue)
    threads, fit = on_one_thread(), Settings()
    record = records.record(threads) | {
        "settings": f"at most {fit.max_iter} iterations, loss_tol {fit.loss_tol:g}, {fit.prior}",
        "scenes": sky.name,
    }
    kept = ("clresample", "galsim", "device", "settings", "scenes")
    log = records.Log(options.folder / "joint.jsonl", {name: record[name] for name in kept})
    run_scenes(options, log)
    galaxies, n_failed = collect(log)
    record["scenes"] = f"{len(log.done)} of {sky.name}"
    maps = bin_galaxies(galaxies, STARTS)
    draw(options.folder, maps)
    numbers = summarise(galaxies, maps, STARTS) | {"n_failed": n_failed}
    report.save(options.folder, "joint", record, **numbers)


def parser():
    parser = Parser(__doc__)
    about = "how many scenes there shall be in all; the paper has 2315"
    parser.add_number("scenes", about, 200)
    parser.add_catalogue()
    parser.add_processes()
    parser.add_folder()
    return parser


if __name__ == "__main__":
    run(main, parser())
