"""Galaxies of all sizes and brightnesses, alone and blended, by defaults: which come out right.

    python -m bench.ladder [--quick] [--only CASE,...] [--seed N] [--json FILE]

case        single, of Sersic n = 1, 2.5, 4; neighbour: the same with one of signal to noise 20 at
            1, 2.5 or 4 r_e and 4 px; pair of equals at 0.5 to 3 r_e; bulge_disk of other colours;
            giant with eight satellites; cosmos: real galaxies drawn 4 and 8 times as large;
            star_as_galaxy, a star fitted as ExtendedSource; galaxy_as_point, the reverse;
            close: two galaxies of similar size and brightness, 0.5 to 2 px apart; ray: a galaxy
            with a cosmic ray across its core, in one channel
mode        one: a survey of three bands, Moffat PSF 4.2 px wide; joint: Euclid and Rubin

Frames are 8 r_e wide, or 65 px, or as their sources need. Positions are the true ones. The truth of
a flux lies between the flux inside the image and that of the whole galaxy: anything between is
right, with ratio 1 and pull 0; beyond, ratio and pull are those to the nearer bound.

A row is one source of a fit:

n, re_px    of its Sersic profile (a disk's); r_e in pixels of the finest image
snr         of the best possible filter for the whole galaxy, in all bands of all images together
ratio, pull flux over truth, (flux - truth) / error; of the band where the pull is largest
chi2        per pixel with weight, all images together
flags       of the source, in the catalogue
silent      over 5 % and 5 sigma off in a band, and the source has none of the flags MISFIT,
            NOT_CONVERGED, SATURATED, AMBIGUOUS, NO_COVERAGE, OUTSIDE_FRAME, UNLISTED. EDGE is no
            excuse: the truth's range allows for light beyond the image
seconds     processor time of the fit, on one thread

The JSON has the ratios and pulls of all bands. `ladder_cases.scene_of` draws a row's scene again.
"""

from __future__ import annotations

import itertools
import time
import warnings

import numpy as np

from clresample import Flag, catalogue, deblend
from clresample.measurement.photometry import fluxes

from .harness import records, scenes
from .harness.clock import in_processes, on_one_thread
from .harness.ladder_cases import CASES, Limits, cosmos_catalogue, scene_of
from .harness.ladder_scenes import MODES
from .harness.options import BadOption, Parser, run

N_SCENES = {
    "single": 150, "neighbour": 40, "pair": 40, "bulge_disk": 30, "giant": 10, "cosmos": 24,
    "star_as_galaxy": 30, "galaxy_as_point": 30, "close": 40,
    "ray": 60,
}  # fmt: skip
N_QUICK = {
    "single": 12, "neighbour": 5, "pair": 4, "bulge_disk": 2, "giant": 1, "cosmos": 2,
    "star_as_galaxy": 2, "galaxy_as_point": 2, "close": 2, "ray": 2,
}  # fmt: skip
QUICK_RE_PX = 16.0  # [px] r_e of --quick, at most: larger frames take most of the time
FIRST_SEED = 1
RIGHT, RIGHT_SIGMA = 0.03, 3.0
WRONG, WRONG_SIGMA = 0.05, 5.0
LOST, LOST_SIGMA = 2.0, 4.0  # factor and sigma by which a source is taken by another
CHI2 = 1.1
SAYS_SO = {
    "MISFIT", "NOT_CONVERGED", "SATURATED", "AMBIGUOUS", "NO_COVERAGE", "OUTSIDE_FRAME", "UNLISTED"
}  # fmt: skip
COVERAGE_RE_PX = (4.0, 32.0)
COVERAGE_SNR = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, np.inf)  # of a band's flux
COLUMNS = records.columns(
    "case:15 mode:5 scene:5d source:6d n:3.1f re_px:6.1f q:4.2f snr:7.0f ratio:9.3f pull:8.1f "
    "chi2:8.2f status:15 flags:24 silent:6 seconds:7.2f"
)


def compare(flux, error, inside, total):
    """Ratios and pulls of fluxes to a truth between two bounds; arrays of one shape."""
    low, high = np.minimum(inside, total), np.maximum(inside, total)
    truth = np.clip(flux, low, high)
    ratio = np.divide(flux, truth, out=np.full_like(truth, np.nan), where=truth > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = np.where(flux == truth, 0.0, (flux - truth) / error)
    return ratio, pull


def rows_of(case, mode, i, scene, result, seconds):
    """Rows of one fitted scene, one for each source."""
    table, (flux, covariance) = catalogue(result), fluxes(result)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)
    ratios, pulls = compare(flux, error, scene.inside, scene.total)
    chi2 = scenes.chi2_of_all(result)
    for s, item in enumerate(scene.items):
        ratio, pull = ratios[s], pulls[s]
        names = [flag.name for flag in Flag(int(table["flags"][s]))]
        wrong = ((np.abs(ratio - 1) > WRONG) & ~(np.abs(pull) <= WRONG_SIGMA)).any()
        band = int(np.argmax(np.nan_to_num(np.abs(pull), nan=np.inf)))
        yield {
            "case": case,
            "mode": mode,
            "scene": i,
            "source": s,
            "role": item.role,
            "n": item.n,
            "re_px": item.re_px,
            "q": item.q,
            "snr": item.snr,
            "ratio": float(ratio[band]),
            "pull": float(pull[band]),
            "chi2": chi2,
            "status": result.status,
            "flags": " ".join(names),
            "silent": bool(wrong and not SAYS_SO & set(names)),
            "seconds": seconds,
            "ratios": ratio.tolist(),
            "pulls": pull.tolist(),
            "total_pulls": ((flux[s] - scene.total[s]) / error[s]).tolist(),
            "snrs": (scene.total[s] / error[s]).tolist(),
            "position_px": list(item.away_px),
        }


def measure(case, mode, seed, i, limits):
    """Rows of the i-th scene of a case."""
    scene = scene_of(case, mode, seed, i, limits)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.process_time()
        try:
            result = deblend(scene.observations, scene.sources)
            rows = list(rows_of(case, mode, i, scene, result, time.process_time() - began))
        except (ValueError, ArithmeticError, RuntimeError) as error:
            rows = failed(case, mode, i, scene, error, time.process_time() - began)
    return rows


def failed(case, mode, i, scene, error, seconds):
    """Rows of a scene that could not be fitted: nothing is within any limit, nothing is silent."""
    nothing = np.full(scene.total.shape[1], np.nan).tolist()
    lists = dict.fromkeys(("ratios", "pulls", "total_pulls", "snrs"), nothing)
    numbers = dict.fromkeys(("ratio", "pull", "chi2"), np.nan)
    return [
        {"case": case, "mode": mode, "scene": i, "source": s, "role": item.role, "n": item.n}
        | {"re_px": item.re_px, "q": item.q, "snr": item.snr, "flags": "", "silent": False}
        | {"status": f"failed: {error}", "seconds": seconds, "position_px": list(item.away_px)}
        | lists
        | numbers
        for s, item in enumerate(scene.items)
    ]


def summarise(rows):
    """Figures by case and mode, and coverage by signal to noise."""
    found = {}
    kinds = dict.fromkeys((row["case"], row["mode"]) for row in rows)
    for case, mode in kinds:
        here = [row for row in rows if (row["case"], row["mode"]) == (case, mode)]
        fits = {row["scene"]: row for row in here}.values()
        found[f"{case}, {mode}"] = {
            "sources": len(here),
            "fluxes": sum(len(row["ratios"]) for row in here),
            "fluxes within 3 % or 3 sigma": _share(here, RIGHT, RIGHT_SIGMA),
            "chi2 <= 1.1": float(np.mean([row["chi2"] <= CHI2 for row in fits])),
            "converged": float(np.mean([row["status"] == "converged" for row in fits])),
            "silently wrong": sum(row["silent"] for row in here),
            "off by 2 and 4 sigma, neither AMBIGUOUS nor MISFIT": sum(map(is_lost, here)),
            "seconds a fit": float(np.mean([row["seconds"] for row in fits])),
        }
    return found | {"68 % intervals, r_e 4 to 32 px, by the flux's S/N": coverage(rows)}


def is_lost(row):
    """True if a flux is off by LOST and LOST_SIGMA without a flag that names the neighbour."""
    ratio, pull = np.array(row["ratios"]), np.array(row["pulls"])
    off = ((ratio > LOST) | (ratio < 1 / LOST)) & (np.abs(pull) > LOST_SIGMA)
    return bool(off.any() and not {"AMBIGUOUS", "MISFIT"} & set(row["flags"].split()))


def _share(rows, relative, sigma):
    ratio, pull = (np.concatenate([row[name] for row in rows]) for name in ("ratios", "pulls"))
    return float(np.mean((np.abs(ratio - 1) <= relative) | (np.abs(pull) <= sigma)))


def coverage(rows):
    """Of single galaxies, in bins: the share of 68 % intervals that reach the truth's range.

    The share of fluxes inside the range stands beside it: they are reached whatever their error.
    """
    low, high = COVERAGE_RE_PX
    rows = [row for row in rows if row["case"] == "single" and low <= row["re_px"] <= high]
    if not rows:
        return {}
    snr, pull = (np.concatenate([row[name] for row in rows]) for name in ("snrs", "pulls"))
    found = {}
    for start, end in itertools.pairwise(COVERAGE_SNR):
        here = np.abs(pull[(snr >= start) & (snr < end)])
        if len(here):
            text = f"{np.mean(here < 1):.3f} of {len(here)}, inside {np.mean(here == 0):.3f}"
            found[f"{start:g} to {end:g}"] = text
    return found


def tasks_of(options):
    """Arguments of `measure` for all requested fits."""
    counts = N_QUICK if options.quick else N_SCENES
    largest = QUICK_RE_PX if options.quick else np.inf
    for case in options.only:
        if case == "cosmos" and cosmos_catalogue() is None:
            print("cosmos: skipped, the data folder has no cosmos/ (set CLRESAMPLE_DATA)")
            continue
        cells = itertools.product(*(x or [None] for x in (options.n, options.re, options.snr)))
        limits = [Limits(*cell, largest) for cell in cells]
        n = options.scenes or (1 if len(limits) > 1 else counts[case])
        scenes_of_case = [some for some in limits for _ in range(n)]
        for mode, (i, some) in itertools.product(options.modes, enumerate(scenes_of_case)):
            yield case, mode, options.seed, i, some


def main(options):
    threads = on_one_thread()
    tasks = list(tasks_of(options))
    if not tasks:
        raise BadOption("no case is left to be fitted")
    record = records.record(threads) | {"seed": options.seed, "settings": "all by default"}
    found = (row for _, r in in_processes(measure, tasks, options.processes) for row in r)
    records.show(
        COLUMNS,
        found,
        record,
        options.json,
        order=lambda row: (list(CASES).index(row["case"]), row["mode"] != MODES[0]),
        summarise=summarise,
    )


def cases(text):
    """An option's type: names of CASES with commas between them."""
    names = text.split(",")
    for name in names:
        if name not in CASES:
            raise ValueError(name)
    return names


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "64 fits, of r_e up to 16 px")
    about = f"of {', '.join(CASES)} (all)"
    parser.add("only", about, type=cases, default=list(CASES), metavar="CASE,...")
    parser.add("modes", "which", nargs="+", choices=MODES, default=MODES)
    parser.add_number("scenes", "scenes of each case, mode and cell")
    for name, what in (("n", "Sersic indices"), ("re", "r_e [px]"), ("snr", "signals to noise")):
        about = f"{what} in place of drawn ones; one scene of each combination"
        parser.add_number(name, about, kind=float, metavar="X", nargs="+")
    parser.add_seed(FIRST_SEED)
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
