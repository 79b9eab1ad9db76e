"""Scenes with one thing wrong in the input: how far fluxes move, and whether a text says why.

    python -m bench.spoilt [--quick] [--only NAME ...] [--clean N] [--json FILE]

Scenes, fitted by defaults: hsc_blend and hsc_cutout of the data folder (left out, saying so, where
they are missing), sim, a simulated one of Euclid and Rubin, and roman, with an undersampled PSF.
Each is fitted as it is and with each of `spoiling.SPOILT` (roman: `spoiling.SAMPLED`). A row is one
fit:

moved       [sigma] change of the brightest source's flux, in errors of the unspoilt fit; of the
            band where it is largest. The fluxes of a source that is listed twice are added
ratio       of that flux to the unspoilt one
own         [sigma] the same change in errors of the spoilt fit
neighbour, n_ratio, n_own   the same of the other source that moved most
chi2        per pixel with weight
flags       of the brightest source, then of that neighbour
named       whether a warning, message or flag names the cause, that the unspoilt fit has not
good        named, or nothing moved by more than 3 errors of the unspoilt fit

Texts that the spoilt fit adds are printed below its row. At last clean simulated scenes are fitted:
a false warning is any text about them or the unspoilt scenes but that a source is under the noise,
that two sources are closer than a pixel where they are, and those of `spoilt_scenes.TRUE_OF`.
"""

from __future__ import annotations

import re
import warnings

import numpy as np

from clresample import Flag, catalogue, deblend, summary
from clresample.sky.sources import SourceWarning

from .harness import records, spoiling, spoilt_scenes
from .harness.clock import in_processes, on_one_thread
from .harness.options import BadOption, Parser, data_folder, run, seed

SCENES = ("hsc_cutout", "hsc_blend", "sim", "roman")
N_CLEAN, N_QUICK = 200, 6
FIRST_CLEAN = 30000
NAMES = dict.fromkeys((*spoiling.SPOILT, *spoiling.SAMPLED))
ENOUGH_SIGMA = 3.0
UNDER_NOISE = "far from any light"  # of messages about sources that no image shows
DOUBLES = "no image tells their fluxes apart"  # of messages about close sources
COLUMNS = records.columns(
    "scene:10 spoilt:21 moved:7.1f ratio:6.2f own:6.1f neighbour:9.1f n_ratio:7.2f n_own:6.1f "
    "chi2:7.2f status:15 flags:26 named:5 good:5"
)


def make_scene(name, data):
    """One of the scenes, or None where the data folder lacks it."""
    if name == "sim":
        return spoilt_scenes.simulated(spoilt_scenes.SIM_SEED, spoilt_scenes.SIM_SOURCES)
    if name == "roman":
        return spoilt_scenes.roman()
    files = {"hsc_blend": "hsc_cosmos_blend.npz", "hsc_cutout": "hst_hsc"}
    if not (data / files[name]).exists():
        return None
    return getattr(spoilt_scenes, name)(data)


def ways_of(name, only):
    """Names of the ways in which a scene is spoilt; only: those that the user chose, or None."""
    ways = spoiling.SAMPLED if name == "roman" else spoiling.SPOILT
    return [way for way in ways if not only or way in only]


class Fitted:
    """A fit: fluxes and errors (S, C) by channel's name, flags, chi2, and all that was said.

    Fluxes of sources with one owner are added, and their flags joined.
    """

    def __init__(self, make, n_sources):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            scene = make()
            result = deblend(scene.observations, scene.sources(), settings=scene.settings)
            table = catalogue(result)
        found = summary(result)
        n = np.array(list(found["n_pixels"].values()))
        chi2 = np.nan_to_num(list(found["chi2"].values()))  # of a band without weight there is none
        self.status, self.chi2 = result.status, float(n @ chi2 / n.sum())
        said = [
            str(w.message) for w in caught
            if not issubclass(w.category, (SourceWarning, DeprecationWarning))
        ]  # fmt: skip
        said += [m for o in result.observations for m in o.messages] + list(result.messages)
        self.texts = list(dict.fromkeys(t for t in said if UNDER_NOISE not in t))
        self.flux, self.error = {}, {}
        for channel in result.channels:
            flux, error = (
                np.asarray(table[f"{key}_{channel}"].value, float) for key in ("flux", "flux_err")
            )
            self.flux[channel] = np.bincount(scene.owners, flux, n_sources)
            self.error[channel] = np.sqrt(np.bincount(scene.owners, error**2, n_sources))
        self.flags = np.zeros(n_sources, int)
        np.bitwise_or.at(self.flags, scene.owners, np.asarray(table["flags"], int))
        self.listed = np.isin(np.arange(n_sources), scene.owners)

    def names(self, i_source):
        return [flag.name for flag in Flag(int(self.flags[i_source]))]


def moves(fit, reference):
    """Change over the reference's error, over the fit's own, and ratio: each (S,).

    They are those of the band in which the first is largest; NaN for sources that the fit lacks.
    """
    channels = [c for c in reference.flux if c in fit.flux]
    old, new = (np.stack([one.flux[c] for c in channels]) for one in (reference, fit))
    error, own = (np.stack([one.error[c] for c in channels]) for one in (reference, fit))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved, by_own, ratio = (new - old) / error, (new - old) / own, new / old
    measured = np.isfinite(moved) & np.isfinite(own)  # not so in a band without weight
    size = np.where(measured, np.abs(moved), -1.0)
    band = size.argmax(axis=0), np.arange(size.shape[1])
    values = np.stack([moved[band], by_own[band], ratio[band]])
    values[:, ~fit.listed | (size.max(axis=0) < 0)] = np.nan
    return values


def row_of(name, spoilt, fit, reference, brightest):
    """The row of one spoilt fit beside the unspoilt one."""
    moved, own, ratio = moves(fit, reference)
    others = np.where(np.isfinite(moved), np.abs(moved), -1.0)
    others[brightest] = -2.0
    other = int(others.argmax())
    words = (spoiling.SPOILT | spoiling.SAMPLED)[spoilt][1]
    texts = [text for text in fit.texts if text not in reference.texts]
    for i in range(len(fit.flags)):
        new = set(fit.names(i)) - set(reference.names(i))
        texts += [f"flag {flag} of source {i}" for flag in sorted(new)]
    named = bool(words) and any(re.search(words, text, re.IGNORECASE) for text in texts)
    largest = np.nanmax(np.abs(moved))
    return {
        "scene": name,
        "spoilt": spoilt,
        "moved": float(moved[brightest]),
        "ratio": float(ratio[brightest]),
        "own": float(own[brightest]),
        "neighbour": float(moved[other]),
        "n_ratio": float(ratio[other]),
        "n_own": float(own[other]),
        "chi2": fit.chi2,
        "status": fit.status,
        "flags": " ".join(fit.names(brightest)) + " | " + " ".join(fit.names(other)),
        "named": named,
        "good": bool(named or largest <= ENOUGH_SIGMA),
        "texts": texts,
    }


def false_texts(texts, name, scene):
    """The texts about a scene, spoilt by nothing, that are not true of it."""
    true = list(spoilt_scenes.TRUE_OF.get(name, ()))
    true += [DOUBLES] if spoilt_scenes.has_doubles(scene) else []
    return [text for text in texts if not any(words in text for words in true)]


def measure(name, data, ways):
    """Rows of a scene, spoilt in each of some ways, and false texts about it as it is."""
    scene = make_scene(name, data)
    if scene is None:
        return None
    n = len(scene.places)
    reference = Fitted(lambda: scene, n)
    snr = sum(
        np.nan_to_num(reference.flux[c] / reference.error[c], posinf=0) ** 2 for c in reference.flux
    )
    brightest = int(np.argmax(snr))
    rows = []
    for way in ways:
        change = (spoiling.SPOILT | spoiling.SAMPLED)[way][0]
        fit = Fitted(lambda change=change: change(scene, brightest), n)
        rows.append(row_of(name, way, fit, reference, brightest))
    return rows, false_texts(reference.texts, name, scene)


def measure_clean(i):
    """False texts about the clean simulated scene of a seed."""
    scene = spoilt_scenes.simulated(i)
    return false_texts(Fitted(lambda: scene, len(scene.places)).texts, "sim", scene)


def summarise(rows, clean):
    """Number of good rows, and false texts about unspoilt scenes; clean: {name: texts}."""
    bad = [f"{row['scene']}, {row['spoilt']}" for row in rows if not row["good"]]
    said = {}
    for texts in clean.values():
        for text in texts:
            said[text] = said.get(text, 0) + 1
    return {
        "spoilt": {
            "rows": len(rows),
            "within 3 sigma or named": len(rows) - len(bad),
            "silent": "; ".join(bad) or "none",
        },
        "unspoilt": {
            "scenes": len(clean),
            "with a false warning": sum(map(bool, clean.values())),
            **{text: f"times {n}" for text, n in sorted(said.items(), key=lambda x: -x[1])},
        },
    }


def main(options):
    threads, data = on_one_thread(), data_folder()
    wanted = [(name, data, ways_of(name, options.only)) for name in options.scenes]
    if not any(ways for *_, ways in wanted):
        raise BadOption(f"--only {' '.join(options.only)}: none of {', '.join(NAMES)}")
    record = records.record(threads) | {"settings": "all by default", "data": str(data)}
    clean = {}

    def spoilt():
        for (name, *_), found in in_processes(measure, wanted, options.processes):
            if found is None:
                print(f"{name}: skipped, it is not in {data} (set CLRESAMPLE_DATA)")
                continue
            if name != "roman":  # of which it is true that the model's PSF is wider than its own
                clean[name] = found[1]
            yield from found[0]

    def summary_of(rows):
        n = (N_QUICK if options.quick else N_CLEAN) if options.clean is None else options.clean
        seeds = [(FIRST_CLEAN + i,) for i in range(n)]
        for (i,), texts in in_processes(measure_clean, seeds, options.processes):
            clean[f"sim {i}"] = texts
        return summarise(rows, clean)

    records.show(
        COLUMNS,
        spoilt(),
        record,
        options.json,
        below=lambda row: records.print_lines(row["texts"]),
        order=lambda row: SCENES.index(row["scene"]),
        summarise=summary_of,
        clean=clean,
    )


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", f"{N_QUICK} clean simulated scenes ({N_CLEAN})")
    parser.add("only", f"of {', '.join(NAMES)} (all)", nargs="+", metavar="NAME")
    parser.add("scenes", "which", nargs="+", choices=SCENES, default=SCENES)
    parser.add("clean", "how many clean simulated scenes", type=seed, metavar="N")
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
