"""Resampling to one pixel grid before a fit, beside fitting each instrument's own pixels.

    python -m bench.noise [--quick] [--scenes N] [--seed S] [--json FILE]

Euclid + Rubin scenes, Rubin's pixels turned by 20 degrees. The same scenes, the same noise:

recipe      native: both images as taken; correlated: Rubin's resampled first, by Lanczos-3 to the
            model's pixels (4 times as many), the correlation of its noise stated, which is what
            scarlet2's manual recommends; white: the same image, the correlation left out
bands       whose fluxes
n           fluxes of signal to noise over 3: true flux over the native fit's error
median, mean   [dB] SDR of the galaxies' models against their truth, both of unit sum
against     [dB] mean of the differences from the native fit, galaxy by galaxy
coverage    share of |flux - truth| < error: 0.683 where errors are right and normal
error       standard error of that share over scenes
width       robust width of (flux - truth) / error, 1.4826 MAD: 1 where errors are right
scatter     the same of (flux - truth) in units of the native fit's error: how accurate fluxes are
bias        median of flux / truth - 1 for signal to noise over 10
seconds     processor time of a scene's fit, set-up and errors included; of the recipes by turns
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from clresample import Settings, fluxes
from clresample.simulation.coadds import resampled
from clresample.simulation.scenes import simulate_scene

from .harness import records, scenes
from .harness.clock import in_chunks, in_processes, on_one_thread
from .harness.judged import error_of_mean, robust
from .harness.options import Parser, n_scenes, run

RECIPES = ("native", "correlated", "white")
BANDS = {"Euclid": slice(0, 1), "Rubin": slice(1, 7)}
N_SCENES, N_QUICK = 120, 4
# The seeds before these serve to choose constants and to report other figures.
FIRST_SEED = 2000
CHUNK = 4  # scenes fitted side by side: some seconds
ANGLE_DEG = 20.0
MIN_SNR, BIAS_SNR = 3.0, 10.0
COLUMNS = records.columns(
    "recipe:10 bands:6 n:5d median:6.2f mean:6.2f against:7.3f coverage:8.3f error:6.3f "
    "width:6.2f scatter:7.3f bias:8.4f seconds:7.3f"
)


def prepared(scene, recipe):
    """The scene as a recipe gives it to the fit."""
    if recipe == "native":
        return scene
    return replace(scene, rubin=resampled(scene.rubin, noise=recipe, grid=scene.euclid.grid))


def measure(seeds):
    """Each recipe's fits of these scenes.

    returns {recipe: [dictionary of each scene: sdr (S,), flux, error, truth (S, 7) [counts],
        seconds, status]}
    """
    found = [simulate_scene(i, angle_deg=ANGLE_DEG) for i in seeds]
    parts = {}
    for recipe in RECIPES:
        blends = [scenes.blend(prepared(scene, recipe), "joint") for scene in found]
        began = time.process_time()
        results = scenes.fit(blends)
        seconds = (time.process_time() - began) / len(found)
        parts[recipe] = [
            _values(scene, result) | {"seconds": seconds}
            for scene, result in zip(found, results, strict=True)
        ]
    return parts


def _values(scene, result):
    truth = np.concatenate([scene.euclid.counts, scene.rubin.counts], axis=1)
    if result.status == "failed":
        lost = np.full(truth.shape, np.nan)
        return {"sdr": lost[:, 0], "flux": lost, "error": lost, "truth": truth, "status": "failed"}
    flux, covariance = fluxes(result)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)
    sdr = np.array(scenes.scores(result, scene))
    return {"sdr": sdr, "flux": flux, "error": error, "truth": truth, "status": result.status}


def rows_of(parts):
    """Rows of all recipes; parts: of `measure`, all chunks in one list."""
    native = parts["native"]
    for recipe, one in parts.items():
        sdr, first = (np.concatenate([s["sdr"] for s in p]) for p in (one, native))
        shared = {
            "median": float(np.nanmedian(sdr)),
            "mean": float(np.nanmean(sdr)),
            "against": float(np.nanmean(sdr - first)),
            "seconds": float(np.mean([s["seconds"] for s in one])),
        }
        for bands, part in BANDS.items():
            yield {"recipe": recipe, "bands": bands} | _fluxes(one, native, part) | shared


def _fluxes(one, native, part):
    """Statistics of the fluxes of some bands."""
    away, error, unit, truth = (
        np.concatenate([get(s, n)[:, part].ravel() for s, n in zip(one, native, strict=True)])
        for get in (
            lambda s, n: s["flux"] - s["truth"],
            lambda s, n: s["error"],
            lambda s, n: n["error"],
            lambda s, n: s["truth"],
        )
    )
    i_scene = np.repeat(np.arange(len(one)), [s["flux"][:, part].size for s in one])
    snr = truth / unit
    good = np.isfinite(away) & np.isfinite(error) & (snr > MIN_SNR)
    held = np.abs(away[good]) < error[good]
    return {
        "n": int(good.sum()),
        "coverage": float(held.mean()),
        "error": error_of_mean(held, i_scene[good]),
        "width": robust(away[good] / error[good]),
        "scatter": robust(away[good] / unit[good]),
        "bias": float(np.median((away / truth)[good & (snr > BIAS_SNR)])),
    }


def main(options):
    threads = on_one_thread()
    seeds = range(options.seed, options.seed + n_scenes(options))
    record = records.record(threads) | {
        "scenes": f"{len(seeds)} joint, parametric galaxies; from seed {options.seed}",
        "settings": f"{Settings()}",
    }
    tasks = [(chunk,) for chunk in in_chunks(seeds, CHUNK)]
    found = in_processes(measure, tasks, options.processes, lambda task: len(task[0]))
    ordered = [chunk for _, chunk in sorted(found, key=lambda pair: pair[0][0].start)]
    parts = {recipe: [s for chunk in ordered for s in chunk[recipe]] for recipe in RECIPES}
    ends = {r: float(np.mean([s["status"] == "converged" for s in p])) for r, p in parts.items()}
    summary = {"share of fits that converged": ends}
    records.show(COLUMNS, rows_of(parts), record, options.json, summarise=lambda _: summary)


def parser():
    parser = Parser(__doc__)
    parser.add_scenes(N_QUICK, N_SCENES)
    parser.add_seed(FIRST_SEED)
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
