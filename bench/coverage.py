"""Error bars of simulated galaxies' catalogues: how often they hold the truth.

    python -m bench.coverage [--quick] [--scenes N] [--json FILE]

A row is one quantity of the galaxies of one kind, fitted in one mode, in one bin of signal to noise
(true flux over reported error; of the fainter band for a colour, of all together for what else
belongs to the galaxy) or in all bins together, from 3 on; a bin without an upper end has
snr_high = null in the JSON:

mode        joint, euclid or rubin; joint-lanczos and joint-drizzle: parametric galaxies on mosaics
            of pixels of 0.7, whose noise is correlated; with "-as-white" the fit assumes white
            noise, otherwise it estimates the correlation
galaxies    parametric: bulge, disk and knots; cosmos: real ones whose light is not clearly
            negative; real: sizes, arms, clumps and ellipticals of a real sky, where asked for
light       drawn: magnitudes uniform in 20 - 29, those of all COSMOS galaxies; even: all light of a
            scene times one factor, so that its sources' median signal to noise, of shapes that are
            known, is log-uniform in 3 - 10000 and no source brighter than magnitude 18. Bins are
            then filled about alike, where magnitudes as drawn leave few fluxes above 300
quantity    flux, colour (of neighbouring bands), position, size, ellipticity
n           values; of a flux one for each galaxy and band
coverage    share of |estimate - truth| < error: 0.683 where errors are right and normal
error       standard error of that share over scenes, whose galaxies and bands hang together
width       robust width of (estimate - truth) / error, 1.4826 MAD: 1 where errors are right
bias        median of estimate / truth - 1 for flux and size, of (estimate - truth) / error for the
            rest
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict

import numpy as np

from clresample import Settings
from clresample.simulation.coadds import mosaic_scene
from clresample.simulation.scenes import simulate_scene

from .harness import records, scenes, truth
from .harness.brightness import evened
from .harness.clock import in_chunks, in_processes, on_one_thread
from .harness.judged import error_of_mean, robust
from .harness.options import BadOption, Parser, run

GALAXIES, REAL = ("parametric", "cosmos"), "real"
EDGES = (3.0, 10.0, 30.0, 100.0, 300.0, np.inf)  # signal to noise
# Scenes of each kind and mode. Of parametric galaxies so many that the standard error of a flux
# bin's coverage is under 0.015: it is 0.010 to 0.014. All take 40 minutes to two hours on two
# cores.
N_SCENES = {
    "parametric": {
        "joint": 550,
        "euclid": 1800,
        "rubin": 700,
        "joint-lanczos": 600,
        "joint-drizzle": 650,
        "joint-lanczos-as-white": 60,
        "joint-drizzle-as-white": 60,
    },
    "cosmos": {"joint": 120, "euclid": 300, "rubin": 120},
    "real": {"joint": 550, "euclid": 1800, "rubin": 700},
}
N_QUICK, N_QUICK_MOSAICS = 5, 2
# Constants were chosen on scenes of seeds before these.
FIRST_SEED = 20000
MODES = tuple(N_SCENES["parametric"])
# How the images of scenes become mosaics, see `mosaic_scene`; in other modes they stay as taken.
MOSAICS = {
    "joint-lanczos": {"kind": "lanczos"},
    "joint-drizzle": {"kind": "drizzle"},
    "joint-lanczos-as-white": {"kind": "lanczos", "noise": "white"},
    "joint-drizzle-as-white": {"kind": "drizzle", "noise": "white"},
}
CHUNK = 5  # scenes fitted side by side: some seconds
# Share of negative light from which a COSMOS galaxy is left out, as no model that is positive can
# have its flux: fluxes above signal to noise 100 come out too high by 0.1 % where it is under this,
# by 0.5 % from here to 0.01, and by 0.65 % to 0.02. Three quarters of the catalogue's galaxies have
# more, from the noise of HST's images.
NEGATIVE = 0.005
COLUMNS = records.columns(
    "mode:22 galaxies:10 light:5 quantity:11 snr_low:7g snr_high:8g n:6d coverage:8.3f "
    "error:6.3f width:6.2f bias:8.4f"
)


def light_of(galaxies, as_drawn):
    """Column `light` of a row: "even" or "drawn"."""
    return "drawn" if as_drawn or galaxies == "cosmos" else "even"


def make_scene(galaxies, mode, folder, seed, as_drawn):
    """A `SimulatedScene` of one of GALAXIES; folder: of COSMOS'; as_drawn: see `light_of`."""
    if galaxies == "cosmos":
        scene = scenes.opened(folder).take(seed)
    else:
        scene = simulate_scene(seed, sky="real" if galaxies == REAL else "plain")
    if light_of(galaxies, as_drawn) == "even":
        scene = evened(scene, instruments(mode))
    if mode not in MOSAICS:
        return scene
    return mosaic_scene(scene, np.random.default_rng(seed), **MOSAICS[mode])


def instruments(mode):
    """Mode of `scenes.MODES` whose instruments one of MODES uses."""
    return mode.partition("-")[0]


def measure(galaxies, mode, folder, seeds, negative=NEGATIVE, as_drawn=False):
    """Results of `truth.compare` for scenes of these seeds, and the statuses of their fits.

    returns [{quantity: (4, n)}, ...], one for each scene that could be fitted; [status, ...]
    """
    parametric = galaxies != "cosmos"
    found = [make_scene(galaxies, mode, folder, seed, as_drawn) for seed in seeds]
    mode = instruments(mode)
    results = scenes.fit([scenes.blend(scene, mode) for scene in found])
    values = []
    for scene, result in zip(found, results, strict=True):
        if result.status != "failed":
            keep = parametric | (truth.negative_light(scene) < negative)
            values.append(truth.compare(result, scene, mode, keep=keep))
    return values, [result.status for result in results]


def rows_of(mode, galaxies, light, values):
    """Rows of one mode, kind of galaxies and of light; values: of `measure`, chunks in one list."""
    for quantity in truth.QUANTITIES:
        found = [one[quantity] for one in values if quantity in one]
        if not found:
            continue
        i_scene = np.repeat(np.arange(len(found)), [v.shape[1] for v in found])
        snr, estimate, true, error = np.concatenate(found, axis=1)
        bins = [*itertools.pairwise(EDGES), (EDGES[0], EDGES[-1])]
        for low, high in bins:
            here = (snr >= low) & (snr < high)
            pull = (estimate - true)[here] / error[here]
            relative = (estimate - true)[here] / true[here]
            row = {"mode": mode, "galaxies": galaxies, "light": light, "quantity": quantity}
            row |= {"snr_low": low, "snr_high": high, "n": int(here.sum())}
            bias = relative if quantity in truth.RELATIVE else pull
            yield row | _statistics(pull, bias, i_scene[here])


def _statistics(pull, bias, i_scene):
    if not len(pull):
        return dict.fromkeys(("coverage", "error", "width", "bias"), np.nan)
    held = np.abs(pull) < 1
    return {
        "coverage": float(held.mean()),
        "error": error_of_mean(held, i_scene),
        "width": robust(pull),
        "bias": float(np.median(bias)),
    }


def fitted(wanted, n_scenes, options):
    """Fits all scenes of `wanted`, pairs (galaxies, mode).

    yields, once all scenes of a pair are done: galaxies, mode, the values of its scenes in the
        order of their seeds, and how many fits ended in which way
    """
    how = options.negative, options.as_drawn
    tasks = [
        (galaxies, mode, options.catalogue, chunk, *how)
        for galaxies, mode in wanted
        for end in [options.seed + n_scenes[galaxies][mode]]
        for chunk in in_chunks(range(options.seed, end), CHUNK)
    ]
    missing = Counter(task[:2] for task in tasks)
    values, ends = defaultdict(dict), defaultdict(Counter)
    done = in_processes(measure, tasks, options.processes, lambda task: len(task[3]))
    for task, (found, statuses) in done:
        kind = task[:2]
        values[kind][task[3].start] = found
        ends[kind].update(statuses)
        missing[kind] -= 1
        if not missing[kind]:
            ordered = [one for _, chunk in sorted(values.pop(kind).items()) for one in chunk]
            yield *kind, ordered, ends[kind]


def main(options):
    galaxies = [name for name in (*GALAXIES, REAL) if name in options.galaxies]
    if "cosmos" in galaxies and scenes.Galaxies(options.catalogue).catalogue is None:
        galaxies.remove("cosmos")
    if not galaxies:
        raise BadOption("--galaxies cosmos: there is no catalogue of them, name one by --catalogue")
    if galaxies == ["cosmos"] and not set(options.modes) - set(MOSAICS):
        raise BadOption(f"--galaxies cosmos: {', '.join(options.modes)} have parametric ones only")
    threads = on_one_thread()
    quick = {m: N_QUICK_MOSAICS if m in MOSAICS else N_QUICK for m in N_SCENES["parametric"]}
    n_scenes = {
        kind: {m: options.scenes or (quick[m] if options.quick else n) for m, n in of.items()}
        for kind, of in N_SCENES.items()
    }
    pairs = itertools.product(galaxies, options.modes)
    wanted = [(kind, mode) for kind, mode in pairs if mode in N_SCENES[kind]]
    counts = ", ".join(f"{n_scenes[kind][mode]} {kind} {mode}" for kind, mode in wanted)
    record = records.record(threads) | {
        "scenes": f"{counts}; from seed {options.seed}",
        "settings": f"{Settings()}",
        "left out": f"COSMOS galaxies with {options.negative:.1%} of negative light or more",
    }
    summary = {"how fits ended": {}}

    def found():
        for kind, mode, values, ends in fitted(wanted, n_scenes, options):
            yield from rows_of(mode, kind, light_of(kind, options.as_drawn), values)
            summary["how fits ended"][f"{kind}, {mode}"] = dict(ends)

    records.show(COLUMNS, found(), record, options.json, summarise=lambda _: summary)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", f"{N_QUICK} scenes of each, {N_QUICK_MOSAICS} of mosaics")
    counts = ", ".join(f"{n} {m}" for m, n in N_SCENES["parametric"].items())
    about = f"how many scenes of each mode and kind of galaxies ({counts}; a few of COSMOS)"
    parser.add_number("scenes", about)
    parser.add_seed(FIRST_SEED)
    parser.add("modes", "which", nargs="+", choices=MODES, default=MODES)
    parser.add_flag("as-drawn", "leave the light of parametric galaxies as drawn")
    about = "which; without a catalogue of COSMOS galaxies only parametric ones (both)"
    parser.add("galaxies", about, nargs="+", choices=(*GALAXIES, REAL), default=GALAXIES)
    about = "of a COSMOS galaxy's light: with more than this it is left out"
    parser.add_number("negative", about, NEGATIVE, float, "SHARE")
    parser.add_catalogue()
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
