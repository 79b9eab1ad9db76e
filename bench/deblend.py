"""Joint deblending of simulated Euclid + Rubin scenes: speed and accuracy.

    python -m bench.deblend [--quick] [--json FILE]

A row is one scene fitted in one mode (batch 1), or one batch of scenes fitted together:

mode               rubin, euclid or joint; all models live on Euclid's pixels and are judged there
ms_per_iteration   median of the fit, per scene; of a batch all time but its set-up and results
galsim_ms          one GalSim quintic render of one band, EUCLID -> RUBIN at N = 118: median of
                   renders between the iterations, in batches before and after them
ratio              ms_per_iteration / galsim_ms
wall_s             whole fit, set-up to result, of a geometry seen for the first time
wall_again_s       the same fit once more
sdr [dB]           of each galaxy's model against its truth, both of unit sum
chi2               per pixel, over all images
"""

from __future__ import annotations

import time

import numpy as np

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.settings import Settings

from .harness import records, scenes
from .harness.clock import on_one_thread
from .harness.options import Parser, run

VIEWS = {"upright": (0.0, False), "turned": (30.0, False), "mirrored": (0.0, True)}
BATCHES = (1, 4, 16, 64)
N_SCENES, N_QUICK = 24, 6
# GalSim renders before and after each batch; the batch is compared with their median time.
N_TICKS = 10
# [s] --quick leaves out batches that would end later, so that it takes less than a minute
QUICK_SECONDS = 42.0
COST = "mode:6 batch:5d n_sources:9d iterations:10d ms_per_iteration:16.3f galsim_ms:9.3f "
COST += "ratio:6.2f wall_s:7.3f"
SCORE = "sdr_median:10.2f chi2:6.3f"
COLUMNS = records.columns(f"seed:4d view:8 {COST} wall_again_s:12.3f {SCORE} converged:9")
BATCH_COLUMNS = records.columns(f"{COST} scenes_per_second:17.2f {SCORE} n_converged:11d")


class Pace:
    """Times a fit's iterations from its progress calls, with a GalSim render at each call.

    clock: `GalSimClock` that renders
    steps_s [s]: time of an iteration between two calls, the renders left out
    paused_s [s]: time of all renders, to be taken off the fit's
    """

    def __init__(self, clock):
        self.clock, self.steps_s, self.paused_s = clock, [], 0.0
        self._last = None

    def __call__(self, n_steps, _):
        now = time.perf_counter()
        if self._last is not None:
            n_before, then = self._last
            self.steps_s.append((now - then) / (n_steps - n_before))
        self.clock.tick()
        self._last = n_steps, time.perf_counter()
        self.paused_s += self._last[1] - now

    def ms(self, result):
        """Median time of an iteration [ms]; of a fit too short for that, the mean."""
        if self.steps_s:
            return float(np.median(self.steps_s)) * 1e3
        return (result.seconds["fit"] - self.paused_s) / max(scenes.iterations(result), 1) * 1e3


def fit_row(scene, mode, clock, settings, rng):
    """One scene fitted twice in one mode."""
    scene = scenes.as_new(scene, rng)
    seconds = []
    for _ in range(2):
        pace, start = Pace(clock), time.perf_counter()
        blend = scenes.blend(scene, mode)
        result = deblend(
            blend.observations, blend.sources, frame=blend.frame, settings=settings, progress=pace
        )
        seconds.append(time.perf_counter() - start - pace.paused_s)
    row = _row(mode, 1, [result], [scene], pace.ms(result), clock)
    return row | {
        "seed": scene.seed,
        "iterations": scenes.iterations(result),
        "wall_s": seconds[0],
        "wall_again_s": seconds[1],
        "seconds": result.seconds,
        "chi2_by_instrument": scenes.chi2(result),
        "converged": result.converged,
    }


def batch_row(batch, clock, settings):
    """Scenes fitted side by side, in joint mode."""
    clock.ticks(N_TICKS)
    start = time.perf_counter()
    blends = [scenes.blend(scene, "joint") for scene in batch]
    results = deblend_many(blends, settings=settings, processes=1)
    seconds = time.perf_counter() - start
    clock.ticks(N_TICKS)
    for result in results:
        if result.status == "failed":
            raise RuntimeError(result.reason)
    n_iterations = sum(map(scenes.iterations, results))
    ms = sum(r.seconds["fit"] for r in results) / max(n_iterations, 1) * 1e3
    return _row("joint", len(batch), results, batch, ms, clock) | {
        "iterations": n_iterations,
        "wall_s": seconds,
        "scenes_per_second": len(batch) / seconds,
        "converged": all(r.converged for r in results),
        "n_converged": sum(r.converged for r in results),
    }


def _row(mode, batch, results, batch_scenes, ms, clock):
    galsim_ms = clock.take_ms()
    sdr = [s for r, scene in zip(results, batch_scenes) for s in scenes.scores(r, scene)]
    return {
        "mode": mode,
        "batch": batch,
        "n_sources": len(sdr),
        "ms_per_iteration": ms,
        "galsim_ms": galsim_ms,
        "ratio": ms / galsim_ms,
        "sdr": sdr,
        "sdr_median": float(np.median(sdr)),
        "chi2": float(np.mean([scenes.chi2_of_all(r) for r in results])),
    }


def batch_rows(found, options, clock, settings, deadline):
    """Rows of growing batches; beyond the number of scenes these come again with other noise."""
    rate = None  # [s] per scene
    for n in options.batches:
        if deadline is not None and rate and time.perf_counter() + n * rate > deadline:
            print(f"batch of {n} left out: {n * rate:.0f} s are too long for --quick", flush=True)
            continue
        again = [
            scenes.with_noise(found[i % len(found)], np.random.default_rng(i)) for i in range(n)
        ]
        row = batch_row(again, clock, settings)
        rate = row["wall_s"] / n
        yield row


def summarise(rows):
    """Medians over scenes and galaxies for each view, and turned views against upright ones."""
    summary = {}
    singles = [row for row in rows if row["batch"] == 1 and "view" in row]
    views = {view: [r for r in singles if r["view"] == view] for view in VIEWS}
    views = {view: found for view, found in views.items() if found}
    for view, found in views.items():
        modes = {m: [r for r in found if r["mode"] == m] for m in scenes.MODES}
        modes = {mode: some for mode, some in modes.items() if some}
        summary[view] = _figures_of(modes)
        if view != "upright" and "upright" in views:
            summary[view] |= _against(views["upright"], modes)
    batches = [row for row in rows if "scenes_per_second" in row]
    if batches:
        summary["ratio per scene in batches"] = {str(r["batch"]): r["ratio"] for r in batches}
        summary["scenes per second"] = {str(r["batch"]): r["scenes_per_second"] for r in batches}
    return summary


def _figures_of(modes):
    """Medians and shares of one view; modes: name -> rows."""
    sdr = {mode: np.concatenate([r["sdr"] for r in some]) for mode, some in modes.items()}
    figures = {"galaxies": len(next(iter(sdr.values())))}
    figures |= {f"sdr {mode} [dB]": float(np.median(s)) for mode, s in sdr.items()}
    if len(sdr) == len(scenes.MODES):
        better = np.maximum(sdr["euclid"], sdr["rubin"])
        figures["joint over euclid [share]"] = float((sdr["joint"] > sdr["euclid"]).mean())
        figures["joint over the better single [share]"] = float((sdr["joint"] > better).mean())
        figures["joint gain over euclid [dB]"] = float(np.mean(sdr["joint"] - sdr["euclid"]))
    for name in ("ratio", "wall_s", "wall_again_s", "chi2", "iterations"):
        for mode, some in modes.items():
            figures[f"{name} {mode}"] = float(np.median([r[name] for r in some]))
    for mode, some in modes.items():
        figures[f"converged {mode} [share]"] = float(np.mean([r["converged"] for r in some]))
    return figures


def _against(upright, modes):
    """Accuracy and time of another view's rows by mode, against the same scenes upright."""
    before = {(r["seed"], r["mode"]): r for r in upright}
    figures = {}
    for mode, some in modes.items():
        pairs = [(r, before[r["seed"], mode]) for r in some]
        gains = np.concatenate([np.subtract(r["sdr"], b["sdr"]) for r, b in pairs])
        times = [r["ms_per_iteration"] / b["ms_per_iteration"] for r, b in pairs]
        figures[f"sdr {mode} against upright [dB]"] = float(np.median(gains))
        figures[f"time {mode} against upright"] = float(np.median(times))
    return figures


def main(options):
    began = time.perf_counter()
    sky = scenes.Scenes(options.catalogue)
    threads = on_one_thread()
    settings = Settings(max_iter=options.max_iter)
    n_scenes = options.scenes or (N_QUICK if options.quick else N_SCENES)
    record = records.record(threads) | {
        "scenes": f"{n_scenes} from seed {options.seed}; {sky.name}",
        "settings": f"at most {settings.max_iter} iterations, loss_tol {settings.loss_tol:g}",
    }
    records.print_record(record)
    views = options.views or (["upright"] if options.quick else list(VIEWS))
    clock, rng = scenes.GalSimClock(), np.random.default_rng(0)
    for mode in scenes.MODES:  # the kernels are built before anything is timed
        fit_row(sky.take(options.seed), mode, clock, Settings(max_iter=5), rng)
    rows, upright = [], []
    records.print_head(COLUMNS)
    for i in range(options.seed, options.seed + n_scenes):
        for view in views:
            angle_deg, flip = VIEWS[view]
            scene = sky.take(i, angle_deg=angle_deg, flip=flip)
            if view == views[0]:
                upright.append(scene)
            for mode in scenes.MODES:
                rows.append(fit_row(scene, mode, clock, settings, rng))
                rows[-1] |= {"view": view, "angle_deg": angle_deg, "mirrored": flip}
                records.print_row(COLUMNS, rows[-1])
    records.print_head(BATCH_COLUMNS)
    deadline = began + QUICK_SECONDS if options.quick else None
    for row in batch_rows(upright, options, clock, settings, deadline):
        rows.append(row)
        records.print_row(BATCH_COLUMNS, row)
    summary = summarise(rows)
    records.print_summary(summary)
    if options.json is not None:
        records.write_json(options.json, {"record": record, "summary": summary, "rows": rows})


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", f"{N_QUICK} scenes, upright only, and batches that fit into the time")
    parser.add_number("scenes", f"how many scenes ({N_SCENES})")
    parser.add_seed()
    about = "Rubin's pixels along Euclid's, turned by 30 degrees, of the opposite parity (all)"
    parser.add("views", about, nargs="+", choices=VIEWS)
    about = f"scenes fitted side by side ({' '.join(map(str, BATCHES))})"
    parser.add_number("batches", about, BATCHES, nargs="*")
    parser.add_number("max-iter", "most iterations of a fit", Settings().max_iter)
    parser.add_catalogue()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
