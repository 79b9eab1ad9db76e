"""Section 5 of the paper: how near resampled galaxies come to those that GalSim draws directly.

    python -m bench.paper.accuracy [--galaxies N] [--printed | --wide] [--folder FOLDER]

Every galaxy is drawn on the observed stamp of 60 x 60 pixels, the truth, and on a model stamp of
the same sky, from which ours (float32 and float64), the paper's scheme (float32) and GalSim
(quintic, its default, and sinc) render the observed one.  SDR [dB] is of stamps of unit sum.
A run continues where it was interrupted; more galaxies add to those that are there.
"""

from __future__ import annotations

import numpy as np

from clresample.simulation.sdr import sdr

from ..harness import records
from ..harness.clock import in_processes, on_one_thread
from ..harness.options import BadOption, Parser, run, survey_pairs, survey_table
from . import figures, report
from .stamps import METHODS, N_OBS, drawn, edge_light, measure, open_galaxies, renderers, stamp

CHUNK = 25  # galaxies measured and logged together: about a second, lost by an interruption
# [arcsec] side of the wide drawings; larger ones change no result of a COSMOS galaxy
FIELD_ARCSEC = 24.0
PADDINGS = (1.0, 1.25, 1.5, 2.0)  # side of the model stamp over that of the observed stamp's sky
N_WORST = 3  # galaxies whose stamps are padded, and whose images are drawn
VISUAL_PAIRS = (("HST", "RUBIN"), ("EUCLID", "EUCLID"), ("EUCLID", "RUBIN"))


def run_chunks(cases, options, log):
    """Measures what the log lacks, in several processes, each on one thread."""
    chunks = [
        (case, start, min(start + CHUNK, options.galaxies))
        for start in range(0, options.galaxies, CHUNK)
        for case in cases
    ]
    missing = [
        (case, options.catalogue, start, stop)
        for case, start, stop in chunks
        if len(log.done.get(key(case, start), ())) < stop - start
    ]
    total = sum(stop - start for _, start, stop in chunks)
    there = total - sum(stop - start for *_, start, stop in missing)
    given = measure, missing, options.processes
    for task, rows in in_processes(*given, lambda task: task[3] - task[2], there, "stamps"):
        log.append(key(task[0], task[2]), rows)


def key(case, start):
    return case.survey_in.name, case.survey_out.name, start


def collect(case, n_galaxies, log):
    """Columns by name, (n_galaxies,) each, SDRs [dB] for the methods."""
    rows = [log.done[key(case, start)] for start in range(0, n_galaxies, CHUNK)]
    table = np.array([row for chunk in rows for row in chunk][:n_galaxies]).T
    with np.errstate(divide="ignore"):  # an exact image: infinite SDR
        sdrs = -10 * np.log10(table[:-1])
    return {**dict(zip(METHODS, sdrs)), "edge": table[-1]}


def summarise(case, found):
    """Means, standard deviations and shares of one survey pair, for the JSON."""
    sdrs = {name: found[name] for name in METHODS}
    same = {name: bool(np.isinf(values).all()) for name, values in sdrs.items()}
    with np.errstate(invalid="ignore"):  # infinite SDRs have no deviation
        return {
            "from": case.survey_in.name,
            "to": case.survey_out.name,
            "n_model": case.n_model,
            "n_galaxies": found["edge"].size,
            "mean": {name: float(values.mean()) for name, values in sdrs.items()},
            "std": {name: float(values.std()) for name, values in sdrs.items()},
            "exact": same,
            "quintic_wins": float(np.mean(found["quintic"] > found["ours"])),
        }


def worst_cases(found, galaxies):
    """The galaxies in which ours does worst against GalSim's default: (case, galaxy), each once."""
    n_rows = galaxies.catalogue.nobjects if galaxies.catalogue else np.inf
    margins = [
        (margin, i, case)
        for case, columns in found.items()
        for i, margin in enumerate(columns["ours"] - columns["quintic"])
    ]
    worst = {}
    for _, i, case in sorted(margins, key=lambda item: item[0]):
        worst.setdefault(i % n_rows, (case, i))
        if len(worst) == N_WORST:
            break
    return list(worst.values())


def padded(case, i, edge, surveys, galaxies):
    """SDRs of one galaxy from ever larger model stamps, and where its edge light ranks.

    edge: light in the edge of all stamps of this survey pair
    returns also, as "wide", the SDRs from stamps of the first size drawn wide, no light folded in
    """
    pair = case.survey_in.name, case.survey_out.name

    def sdrs(**options):
        larger = stamp(surveys, pair, **options)
        model, truth = drawn(larger, galaxies.take(i, larger))
        rendered = {m: renderers(larger)[m](model[None])[0] for m in ("ours", "quintic")}
        return {"n_model": larger.n_model, "edge": float(edge_light(model))} | {
            m: float(sdr(truth, image, unit_sum=True)) for m, image in rendered.items()
        }

    return {
        "from": pair[0],
        "to": pair[1],
        "galaxy": i,
        "edge_rank": float(np.mean(edge <= edge[i])),
        "padded": [sdrs(padding=side, field_arcsec=case.field_arcsec) for side in PADDINGS],
        "wide": sdrs(field_arcsec=FIELD_ARCSEC),
    }


def images(case, i, galaxies):
    """One galaxy's resampling, for a figure."""
    model, truth = drawn(case, galaxies.take(i, case))
    ours, galsim = (renderers(case)[name](model[None])[0] for name in ("ours", "quintic"))
    sdrs = tuple(float(sdr(truth, image, unit_sum=True)) for image in (ours, galsim))
    title = f"{case.survey_in.name} → {case.survey_out.name}"
    return figures.Images(title, model, truth, ours, galsim, sdrs)


def draw_maps(folder, name, pairs):
    """Draws the figures SDR, SDR_diff and SDR_sinc, from summaries of survey pairs."""
    names = list(survey_table(False))

    def table(value):
        values = np.full((len(names), len(names)), np.nan)
        for pair in pairs:
            values[names.index(pair["from"]), names.index(pair["to"])] = value(pair)
        return values

    mean, std = (
        {m: table(lambda pair, m=m, kind=kind: pair[kind][m]) for m in METHODS}
        for kind in ("mean", "std")
    )
    both = np.array([mean["ours"], mean["quintic"]])
    limits = np.nanmin(both), np.nanmax(both)
    Map = figures.Map
    sets = {
        "SDR": [
            Map("mean SDR, ours [dB]", mean["ours"], limits=limits),
            Map("mean SDR, GalSim quintic [dB]", mean["quintic"], limits=limits),
        ],
        "SDR_diff": [
            Map("deviation, ours [dB]", std["ours"]),
            Map("deviation, GalSim quintic [dB]", std["quintic"]),
            Map("mean, ours minus quintic [dB]", mean["ours"] - mean["quintic"], diverging=True),
        ],
        "SDR_sinc": [
            Map("mean SDR, GalSim sinc [dB]", mean["sinc"], limits=limits),
            Map("deviation, GalSim sinc [dB]", std["sinc"]),
            Map("mean, ours minus sinc [dB]", mean["ours"] - mean["sinc"], ".2f", diverging=True),
        ],
    }
    for label, maps in sets.items():
        figures.heat_maps(
            folder / f"{name}-{label}.png",
            maps,
            rows=names,
            columns=names,
            row_label="from (finer pixels)",
            column_label="to",
        )


def draw_examples(folder, name, found, chosen, surveys, galaxies):
    """Draws the figures visual, of a galaxy of median SDR, and visual_edge, of the worst.

    returns titles and SDRs [dB] of the first
    """
    worst = [images(case, i, galaxies) for case, i in chosen]
    figures.resampled(folder / f"{name}-visual_edge.png", worst)
    reference = found[list(found)[-1]]["ours"]
    typical = int(np.argmin(np.abs(reference - np.median(reference))))
    field_arcsec = next(iter(found)).field_arcsec
    cases = [stamp(surveys, pair, field_arcsec=field_arcsec) for pair in VISUAL_PAIRS]
    visual = [images(case, typical, galaxies) for case in cases]
    figures.resampled(folder / f"{name}-visual.png", visual)
    return [{"title": v.title, "ours": v.sdr[0], "quintic": v.sdr[1]} for v in visual]


def evaluate(folder, name, found, surveys, galaxies):
    """Draws all figures; returns the numbers from which the findings are made."""
    pairs = [summarise(case, columns) for case, columns in found.items()]
    draw_maps(folder, name, pairs)
    # where both surveys are the same, ours cannot lose
    off = {c: columns for c, columns in found.items() if c.survey_in != c.survey_out} or found
    sdrs, quintic, edge = (
        np.concatenate([columns[column] for columns in off.values()])
        for column in ("ours", "quintic", "edge")
    )
    chosen = worst_cases(off, galaxies)
    worst = [padded(case, i, off[case]["edge"], surveys, galaxies) for case, i in chosen]
    figures.edges(folder / f"{name}-edges.png", sdrs - quintic, edge, worst)
    return {
        "pairs": pairs,
        "worst": worst,
        "edge_correlation": float(np.corrcoef(sdrs, np.log(edge))[0, 1]),
        "visual": draw_examples(folder, name, off, chosen, surveys, galaxies),
    }


def main(options):
    if options.printed and options.wide:
        raise BadOption("--wide has the notebooks' parameters: leave --printed out")
    name = "accuracy" + "-printed" * options.printed + "-wide" * options.wide
    field_arcsec = FIELD_ARCSEC * options.wide
    surveys, galaxies = survey_table(options.printed), open_galaxies(options.catalogue)
    threads = on_one_thread()
    record = records.record(threads) | {
        "surveys": "printed table" if options.printed else "notebooks",
        "drawing": f"of {field_arcsec:g} arcsec, cut" if options.wide else "of the stamps alone",
        "galaxies": f"{options.galaxies} {galaxies.name}, turned and flipped at random",
    }
    settings = {
        key: record[key] for key in ("clresample", "galsim", "device", "surveys", "drawing")
    }
    settings |= {"galaxies": galaxies.name, "stamp": N_OBS}
    log = records.Log(options.folder / f"{name}.jsonl", settings)
    pairs = options.pairs or survey_pairs()
    cases = [stamp(surveys, pair, field_arcsec=field_arcsec) for pair in pairs]
    run_chunks(cases, options, log)
    found = {case: collect(case, options.galaxies, log) for case in cases}
    numbers = evaluate(options.folder, name, found, surveys, galaxies)
    report.save(options.folder, name, record, **numbers)


def parser():
    parser = Parser(__doc__)
    parser.add_surveys()
    parser.add_galaxies(1000)
    about = f"cut the stamps from drawings of {FIELD_ARCSEC:g} arcsec, so that no light folds in"
    parser.add_flag("wide", about)
    parser.add_processes()
    parser.add_folder()
    return parser


if __name__ == "__main__":
    run(main, parser())
