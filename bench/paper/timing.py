"""Section 4 of the paper: times of ours, the paper's scheme and GalSim on the paper's grid.

    python -m bench.paper.timing [--seconds S] [--printed] [--pairs FROM-TO ...] [--folder FOLDER]

Stamps of 20 to 200 model pixels a side, from every survey to all of larger pixels, aligned; then
both schemes on one pair up to 400 pixels, turned as well, all sizes in turn.  Times are medians of
one image of one band, from NumPy array to NumPy array, one thread each, all methods called in turn;
set-up is apart: what the first image takes beyond a later one, with the kernels compiled.
"""

from __future__ import annotations

import functools
import itertools
import time

import numpy as np
from tqdm import tqdm

from clresample.paper.operator.resampler import PaperResampler

from ..harness import records
from ..harness.cases import Case, Galaxies, check_observed
from ..harness.clock import interleaved_ms, on_one_thread
from ..harness.options import Parser, run, survey_pairs, survey_table
from . import figures, report
from .timing_findings import PAPER_FIT, line_fit, means

SIZES = (20, 30, 50, 70, 100, 150, 200)  # [model pixels a side], the paper's
MAIN_PAIR, MAIN_SIZES, ANGLES_DEG = ("EUCLID", "RUBIN"), (50, 100, 200, 300, 400), (0.0, 30.0)
N_SETUPS = 3  # of each method; the first compiles and does not count


def plan(options):
    """Cases to time, by pair and size: the paper's grid."""
    surveys = survey_table(options.printed)
    pairs = options.pairs or [pair for pair in survey_pairs() if pair[0] != pair[1]]
    sizes = options.sizes or SIZES
    return {(*pair, n): Case(*(surveys[name] for name in pair), n) for pair in pairs for n in sizes}


def measure(case, galaxies, seconds):
    """Times of one case: {"ms": one image, "setup_ms": before the first}, by method."""
    image = case.draw(galaxies.take(0, case))[0]

    def operator(**options):
        op = case.operator(**options)
        return lambda: op(image)

    def galsim(interpolant):
        render = case.galsim(interpolant)
        return lambda: render(image)

    makers = {
        "ours": operator,
        "paper": lambda: operator(scheme=PaperResampler),
        "quintic": lambda: galsim("quintic"),
        "sinc": lambda: galsim("sinc"),
    }
    calls, first_ms = {}, {}
    for name, make in makers.items():
        times = []
        for _ in range(N_SETUPS):
            start = time.perf_counter()
            calls[name] = make()
            calls[name]()
            times.append(time.perf_counter() - start)
        first_ms[name] = 1e3 * float(np.median(times[1:]))
    ms = interleaved_ms(calls, seconds=seconds)
    return {"ms": ms, "setup_ms": {n: max(0.0, first_ms[n] - ms[n]) for n in ms}}


def measure_schemes(surveys, sizes, galaxies, seconds):
    """Times [ms] of both schemes on the main pair, all sizes and angles in turn.

    returns a row for each angle; its columns run over the sizes: times "ours" and "paper", and
        "products", the multiply-adds of the paper's contraction
    """
    survey_in, survey_out = (surveys[name] for name in MAIN_PAIR)
    calls, products = {}, {}
    for n_model, angle in itertools.product(sizes, ANGLES_DEG):
        case = Case(survey_in, survey_out, n_model, angle)
        image = case.draw(galaxies.take(0, case))[0]
        ours, paper = case.operator(), case.operator(PaperResampler)
        calls[angle, n_model, "ours"] = functools.partial(ours, image)
        calls[angle, n_model, "paper"] = functools.partial(paper, image)
        products[angle, n_model] = paper.n_terms * case.n_obs**2
    ms = interleaved_ms(calls, seconds=seconds * len(calls))
    return [
        {
            "angle_deg": angle,
            "n_model": list(sizes),
            **{name: [ms[angle, n, name] for n in sizes] for name in ("ours", "paper")},
            "products": [products[angle, n] for n in sizes],
        }
        for angle in ANGLES_DEG
    ]


def main(options):
    cases, galaxies = plan(options), Galaxies(options.catalogue)
    for case in cases.values():
        check_observed(case)
    threads = on_one_thread()
    record = records.record(threads) | {
        "surveys": "printed table" if options.printed else "notebooks",
        "times": "one image of one band, NumPy to NumPy, medians of interleaved calls",
    }
    settings = {
        key: record[key]
        for key in ("clresample", "galsim", "device", "machine", "threads", "surveys")
    }
    log = records.Log(options.folder / "timing.jsonl", settings | {"seconds": options.seconds})
    for key, case in tqdm(cases.items(), desc="timing", unit=" cases"):
        if key not in log.done:
            log.append(key, measure(case, galaxies, options.seconds))
    sizes = options.sizes or MAIN_SIZES
    if (key := ("schemes", *sizes)) not in log.done:
        surveys = survey_table(options.printed)
        log.append(key, measure_schemes(surveys, sizes, galaxies, options.seconds))
    schemes = log.done[key]
    rows = [
        {"from": name_in, "to": name_out, "n_model": n_model, "n_obs": case.n_obs}
        | log.done[name_in, name_out, n_model]
        for (name_in, name_out, n_model), case in cases.items()
    ]
    sizes, running = means(rows, "ms")
    _, setups = means(rows, "setup_ms")
    fits = {scheme: line_fit(rows, scheme)[0] for scheme in ("paper", "ours")}
    figures.time_ratios(options.folder / "timing-time_ratios.png", rows, fits, PAPER_FIT)
    figures.absolute_timings(options.folder / "timing-absolute_timings.png", sizes, running, setups)
    figures.schemes(options.folder / "timing-schemes.png", schemes)
    report.save(options.folder, "timing", record, rows=rows, schemes=schemes)


def parser():
    parser = Parser(__doc__)
    parser.add_sizes(SIZES)
    parser.add_seconds(1.0, "case")
    parser.add_surveys()
    parser.add_catalogue()
    parser.add_folder()
    return parser


if __name__ == "__main__":
    run(main, parser())
