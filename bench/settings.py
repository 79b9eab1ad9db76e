"""Accuracy of simulated scenes' models with several settings, each in all modes, side by side.

    python -m bench.settings [--quick] [--scenes N] [--settings NAME ...] [--json FILE]

settings   default; prior: PaperSettings(prior=SingleScalePrior()), one strength and scale of
           structure for all sources; paper: PaperSettings(), the constraints alone
mode       rubin, euclid or joint, all judged on Euclid's pixels
median, mean   [dB] SDR of the galaxies' models against their truth, both of unit sum
worse      share of galaxies more than 0.5 dB under the better single survey: of the joint fits
below      [dB] mean SDR minus the mean of the better of both single surveys
against    [dB] mean of the differences from the first settings, galaxy by galaxy
error      [dB] its standard error over scenes, whose galaxies hang together
converged  share of the fits; iterations: their median; seconds: processor time of a scene
moved      with --continued, share of the fluxes that change by more than 0.2 of their errors when a
           fit goes on for ten times as many iterations; redrawn: share of the galaxies whose SDR
           changes by more than 0.1 dB

The same scenes and noise for all; fits of many scenes side by side.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np

from clresample import PaperSettings, Settings, SingleScalePrior
from clresample.measurement.photometry import fluxes

from .harness import records, scenes
from .harness.clock import in_chunks, in_processes, on_one_thread
from .harness.judged import error_of_mean
from .harness.options import Parser, n_scenes, run

SETTINGS = {
    "default": Settings(),
    "prior": PaperSettings(prior=SingleScalePrior()),
    "paper": PaperSettings(),
}
N_SCENES, N_QUICK = 120, 8
CHUNK = 4  # scenes fitted side by side: some seconds
WORSE_DB = 0.5
# A fit is continued for so many times its iterations; what then counts as moved and redrawn.
LONGER, MOVED_SIGMA, REDRAWN_DB = 10, 0.2, 0.1
COLUMNS = records.columns(
    "settings:8 mode:6 n:4d median:6.2f mean:6.2f worse:5.3f below:6.2f against:7.3f "
    "error:5.3f chi2:5.3f converged:9.2f iterations:10.0f seconds:7.3f moved:6.4f redrawn:7.3f"
)


def measure(names, folder, continued, seeds):
    """Scenes fitted with several settings in all modes: SDRs, chi2, how the fits ended.

    continued: also what changes when fits go on
    returns {(settings, mode): [dictionary of each scene]}
    """
    found = [scenes.opened(folder).take(i) for i in seeds]
    parts = {}
    for name, mode in itertools.product(names, scenes.MODES):
        blends = [scenes.blend(scene, mode) for scene in found]
        began = time.process_time()
        results = scenes.fit(blends, settings=SETTINGS[name])
        seconds = (time.process_time() - began) / len(found)
        parts[name, mode] = [
            _scores(scene, result) | {"seconds": seconds}
            for scene, result in zip(found, results, strict=True)
        ]
        if continued:
            for part, scene, blend, result in zip(
                parts[name, mode], found, blends, results, strict=True
            ):
                if "chi2" in part:
                    part |= _changes(scene, blend, result, SETTINGS[name])
    return parts


def _endless(settings):
    """Tolerances with which no fit has converged."""
    return {"loss_tol": 0} if isinstance(settings, Settings) else {"rel_tol": 0}


def _changes(scene, blend, result, settings):
    """Changes of fluxes [their errors] and SDRs [dB] where a fit goes on."""
    n = LONGER * max(scenes.iterations(result), 1)
    (later,) = scenes.fit([blend], settings=replace(settings, max_iter=n, **_endless(settings)))
    (flux, covariance), (flux_later, _) = fluxes(result), fluxes(later)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)
    known = np.isfinite(error) & (error > 0)
    sdr = np.subtract(scenes.scores(later, scene), scenes.scores(result, scene))
    return {
        "flux_change": (np.abs(flux_later - flux)[known] / error[known]).tolist(),
        "sdr_change": np.abs(sdr).tolist(),
    }


def _scores(scene, result):
    if result.status == "failed":
        return {"sdr": [float("nan")] * len(scene.profiles), "status": result.status}
    return {
        "sdr": scenes.scores(result, scene),
        "status": result.status,
        "chi2": scenes.chi2_of_all(result),
        "iterations": scenes.iterations(result),
    }


def rows_of(parts):
    """Rows of {(settings, mode): [what `measure` returns of each scene]}, without failed fits."""
    names = dict.fromkeys(name for name, _ in parts)
    sdr = {key: np.concatenate([p["sdr"] for p in some]) for key, some in parts.items()}
    i_scene = np.repeat(*_lengths(next(iter(parts.values()))))
    for name in names:
        singles = [sdr[name, mode] for mode in scenes.MODES if mode != "joint"]
        better = np.maximum(*singles)
        for mode in scenes.MODES:
            some, found = parts[name, mode], sdr[name, mode]
            fitted = [p for p in some if "chi2" in p]
            gain = found - sdr[next(iter(names)), mode]
            yield (
                {
                    "settings": name,
                    "mode": mode,
                    "n": int(np.isfinite(found).sum()),
                    "median": float(np.nanmedian(found)),
                    "mean": float(np.nanmean(found)),
                    "worse": float((found < better - WORSE_DB).mean()),
                    "below": float(np.nanmean(found) - np.nanmean(better)),
                    "against": float(np.nanmean(gain)),
                    "error": error_of_mean(gain, i_scene),
                    "converged": float(np.mean([p["status"] == "converged" for p in some])),
                }
                | {
                    key: float(form([p[key] for p in fitted]))
                    for key, form in (
                        ("chi2", np.mean),
                        ("iterations", np.median),
                        ("seconds", np.mean),
                    )
                }
                | {
                    name: _share(fitted, key, limit)
                    for name, key, limit in (
                        ("moved", "flux_change", MOVED_SIGMA),
                        ("redrawn", "sdr_change", REDRAWN_DB),
                    )
                }
            )


def _share(parts, key, limit):
    """Share of the values of all parts above a limit; NaN without any."""
    values = np.concatenate([p.get(key, []) for p in parts])
    return float((values > limit).mean()) if values.size else float("nan")


def _lengths(parts):
    """Indices of the scenes, and how many galaxies each has."""
    return np.arange(len(parts)), [len(p["sdr"]) for p in parts]


def main(options):
    threads = on_one_thread()
    seeds = range(options.seed, options.seed + n_scenes(options))
    record = records.record(threads) | {
        "scenes": f"{len(seeds)} from seed {options.seed}; {scenes.Scenes(options.catalogue).name}",
        "settings": "; ".join(f"{name} = {SETTINGS[name]}" for name in options.settings),
    }
    given = options.settings, options.catalogue, options.continued
    tasks = [(*given, chunk) for chunk in in_chunks(seeds, CHUNK)]
    found = in_processes(measure, tasks, options.processes, lambda task: len(task[-1]))
    ordered = [chunk for _, chunk in sorted(found, key=lambda pair: pair[0][-1].start)]
    keys = itertools.product(options.settings, scenes.MODES)
    parts = {key: [one for chunk in ordered for one in chunk[key]] for key in keys}
    fits = {f"{name}, {mode}": some for (name, mode), some in parts.items()}
    records.show(COLUMNS, rows_of(parts), record, options.json, fits=fits)


def parser():
    parser = Parser(__doc__)
    parser.add_scenes(N_QUICK, N_SCENES)
    parser.add_seed()
    about = f"which, of {', '.join(SETTINGS)} (default prior)"
    default = ("default", "prior")
    parser.add("settings", about, nargs="+", choices=SETTINGS, default=default, metavar="NAME")
    parser.add_flag("continued", f"also let each fit go on, {LONGER} times as long")
    parser.add_catalogue()
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
