"""Whole fields: simulated mosaics to a catalogue by the command, compared with the truth.

    python -m bench.field [--quick] [--json FILE]
    python -m bench.field --sizes 4096
    python -m bench.field --search-only --sizes 1024 --fields 16 --seed 100

A row is one size of field, run as a user does: simulated, written, `clresample field` in a process
of its own with workers. With --fields N it is N fields of successive seeds together; with
--search-only sources are searched and not fitted, in this process.

n_truth, n_sources  sources with signal to noise over 5 in the truth, and rows of the catalogue;
                    signal to noise is that of the best possible filter over all channels
completeness        share found of those at 20 - 100 with no neighbour within 8 model pixels; a
                    source is found where a catalogue row within 4 pixels is its own
faint, bright       the same at 10 - 20, and over 100
close               share found of those over 20 that have a neighbour within 8 pixels, whatever its
                    brightness and distance: some of these pairs cannot be separated
spurious            share of the rows that are no true source's own: nothing within 4 pixels, or
                    only what another row has found
flux_bias           median of (flux - truth) / truth of those found over 20 without neighbour, all
                    channels
pull_width          of theirs (flux - truth) / error: 1.4826 MAD
core_s_per_source   processor time of all processes over all rows
wall_s, peak_gb     of the command; the memory is that of all its processes together
stage               seconds of wall time by stage
n_pairs             fluxes judged of sources found over 20 that are blended: a neighbour lies within
                    16 pixels, two widths of Rubin's PSF. Of 60 sources at most, and those that the
                    truth has at 5 sigma of a point source's flux or more
pairs, aperture_factor, forced_factor
                    1.4826 median |flux / truth - 1| of theirs, and that of PSF-matched aperture
                    photometry, and of forced profile photometry, over it (harness/photometry.py)
close_...           the same of those with a neighbour within 8 pixels alone, in the JSON file
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from clresample import simulate_field

from .harness import photometry, records
from .harness.clock import ONE_THREAD, on_all_cores
from .harness.judged import NEAR_PX, Judged, fluxes, robust, shares, typical
from .harness.options import Parser, run
from .harness.runs import fitted, found_in

SIZES, QUICK_SIZES = (1024, 2048), (384,)
BANDS, QUICK_BANDS = "ugrizy", "ri"
MAX_PAIRS, BLENDED_PX = 60, 16.0
N_SCALE, SCALE_SNR = 20, 50.0  # sources alone, of each field, that say what part apertures see
PUBLISHED = "36 (plain) or as published (real)"
MIN_FLUX = 5.0  # [sigma] of a point source's flux: fainter ones say how deep a band is
COLUMNS = records.columns(
    "n_model:7d n_truth:7d n_sources:9d completeness:12.3f faint:6.3f bright:6.3f close:6.3f "
    "spurious:8.3f flux_bias:9.4f pull_width:10.3f n_pairs:7d pairs:6.3f aperture_factor:15.2f "
    "forced_factor:13.2f core_s_per_source:17.3f wall_s:7.1f peak_gb:7.2f status:20"
)


def compared(fields, channels):
    """Figures of several fields' catalogues compared with their truth.

    fields: of (table, truth, n_model); channels: names
    """
    judged = [
        Judged(np.stack([table["y"].value, table["x"].value], axis=1), truth, n_model)
        for table, truth, n_model in fields
    ]
    flux, error, true = (
        np.concatenate(some)
        for some in zip(
            *(
                fluxes(table, truth, one.judged(), one.own, channels)
                for one, (table, truth, _) in zip(judged, fields, strict=True)
            ),
            strict=True,
        )
    )
    return counted(judged) | {
        "flux_bias": float(np.nanmedian((flux - true) / true)),
        "pull_width": robust((flux - true) / error),
    }


def counted(judged):
    """The figures of a search alone."""
    return {
        "n_truth": int(sum((one.snr > 5).sum() for one in judged)),
        "n_sources": sum(len(one.at) for one in judged),
    } | shares(judged)


def beside_others(fields, channels, most_px):
    """Fluxes of sources with a neighbour within most_px beside what others measure of them.

    fields: of (table, SimulatedField, n_model)
    """
    ours, theirs, alone, n_left = [], [], [], MAX_PAIRS
    for table, field, n_model in fields:
        one = Judged(np.stack([table["y"].value, table["x"].value], axis=1), field.truth, n_model)
        blended = np.flatnonzero(one.pairs(most_px=most_px))[:n_left]
        n_left -= len(blended)
        lone = np.flatnonzero(one.pairs(BLENDED_PX, np.inf) & (one.snr > SCALE_SNR))[:N_SCALE]
        for chosen, found in ((blended, theirs), (lone, alone)):
            flux, _, true = fluxes(table, field.truth, chosen, one.own, channels)
            deep = true > MIN_FLUX * photometry.point_errors(field.mosaics)
            measured = photometry.compared(field.mosaics, one.at, one.own[chosen], true)
            found.append({name: np.where(deep, m, np.nan) for name, m in measured.items()})
            if found is theirs:
                ours.append(np.where(deep, flux / true, np.nan))
    scatter = {"ours": typical(np.concatenate(ours) - 1)}
    for name in ("aperture", "forced"):
        pairs, singles = (np.concatenate([m[name] for m in f], axis=-2) for f in (theirs, alone))
        scatter[name] = photometry.least_scatter(pairs, singles, typical)
    return {
        "n_pairs": int(np.isfinite(np.concatenate(ours)).sum()),
        "pairs": scatter["ours"],
        "aperture_factor": scatter["aperture"] / scatter["ours"],
        "forced_factor": scatter["forced"] / scatter["ours"],
    }


def simulated(size, number, options):
    return simulate_field(
        options.seed + number,
        sky=options.sky,
        n_pixels=size,
        density=options.density,
        faintest=options.faintest,
        rubin_bands=tuple(QUICK_BANDS if options.quick else BANDS),
        psf_variation=0.1,
        bad_columns=2,
    )


def searched(size, options):
    """The row of a search without fits."""
    judged, core_s, wall_s = [], 0.0, 0.0
    for number in range(options.fields):
        field = simulated(size, number, options)
        with tempfile.TemporaryDirectory() as folder:
            places, core, wall = found_in(field, Path(folder))
        judged.append(Judged(places, field.truth, size))
        core_s, wall_s = core_s + core, wall_s + wall
    row = dict.fromkeys((name for name, *_ in COLUMNS), float("nan")) | counted(judged)
    return row | {
        "n_model": size,
        "n_pairs": 0,
        "core_s_per_source": core_s / max(row["n_sources"], 1),
        "wall_s": wall_s,
        "stage": {"search": wall_s},
        "status": "not fitted",
    }


def row_of(size, options):
    """The row of one size of field."""
    fields, taken = [], []
    for number in range(options.fields):
        field = simulated(size, number, options)
        table, took = fitted(field, options.workers)
        fields.append((table, field, size))
        taken.append(took)
    channels = ("VIS", *(QUICK_BANDS if options.quick else BANDS))
    row = compared([(table, field.truth, n) for table, field, n in fields], channels)
    stage, fits = Counter(), Counter()
    for took in taken:
        stage.update(took["stage"])
        fits.update(took["fits"])
    return (
        row
        | beside_others(fields, channels, BLENDED_PX)
        | {f"close_{k}": v for k, v in beside_others(fields, channels, NEAR_PX).items()}
        | {
            "n_model": size,
            "core_s_per_source": sum(t["core_s"] for t in taken) / max(row["n_sources"], 1),
            "wall_s": sum(t["wall_s"] for t in taken),
            "peak_gb": max(t["peak_gb"] for t in taken),
            "stage": dict(stage),
            "status": ", ".join(f"{n} {how}" for how, n in sorted(fits.items())),
        }
    )


def main(options):
    threads = on_all_cores()
    sizes = options.sizes or (QUICK_SIZES if options.quick else SIZES)
    record = records.record(threads) | {
        "fields": f"{options.fields} from seed {options.seed}, {options.sky} sky, "
        f"{options.density or PUBLISHED} sources per square arcminute to i = "
        f"{options.faintest:g}, Euclid VIS and Rubin "
        f"{QUICK_BANDS if options.quick else BANDS} at 12 degrees",
        "workers": f"{options.workers}, {' '.join(ONE_THREAD)} = 1 each",
    }
    measure = searched if options.search_only else row_of
    rows = (measure(size, options) for size in sizes)
    records.show(COLUMNS, rows, record, options.json, below=records.print_stages)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "one field of 384 pixels, two bands of Rubin")
    parser.add_sizes(SIZES)
    parser.add_density(None, " (36; of a real sky as published)")
    parser.add_sky(("plain", "real", "bright"), "of simulated fields, see simulate_field")
    parser.add_number("faintest", "i magnitude of the faintest sources", 26.0, float, "MAG")
    parser.add_number("fields", "fields of each size, of successive seeds", 1)
    parser.add_flag("search-only", "search for sources, without fits")
    parser.add_number("workers", "processes", 2)
    parser.add_seed(0, "of the first field")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
