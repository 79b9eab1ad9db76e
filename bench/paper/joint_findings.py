"""Galaxies of the joint fits by magnitude, and what they say about the paper's statements."""

from __future__ import annotations

import numpy as np

from clresample.simulation.scenes import MAGNITUDE_RANGE

from ..harness.scenes import MODES
from .report import Finding

SINGLES = tuple(mode for mode in MODES if mode != "joint")
TITLES = {"rubin": "Rubin alone", "euclid": "Euclid alone"}
START_NAMES = {
    "own": "starting from nothing but positions",
    "sersic": "starting from Sersic fits to the truth, as the paper does",
}
# Bins a side: as many as leave this many galaxies to a bin.
N_BINS, GALAXIES_PER_BIN = (9, 6, 3), 12
# Bins with fewer galaxies have a mean, but no say.
FEWEST = 5
# Standard errors by which a difference counts.
CERTAIN = 2.0
# [mag] A galaxy is called bright in a survey up to the middle of the range.
BRIGHT = sum(MAGNITUDE_RANGE) / 2
REGIONS = {
    "bright in both": (True, True),
    "bright in Euclid only": (True, False),
    "bright in Rubin only": (False, True),
    "faint in both": (False, False),
}
VIRTUALLY_ALL = 0.9  # of the bins
OVER_EUCLID, OVER_BETTER = 0.70, 0.50  # shares of the galaxies that joint fits are asked to win
MEDIANS = {"euclid": 5.7, "joint": 7.0}  # [dB] asked of fits without knowledge of the truth


def bin_galaxies(galaxies, starts):
    """Means in bins of Euclid's magnitude (rows) and of the brightest in Rubin (columns).

    galaxies: name -> (n,): euclid_mag, rubin_mag, and SDRs of every start-mode
    returns edges (n + 1,), number (n, n), mean {start-mode: (n, n)}, and of joint minus each single
        mode gain and error, its standard error, {start-mode: (n, n)}; NaN where there is none
    """
    n_galaxies = len(galaxies["euclid_mag"])
    wanted = [n for n in N_BINS if n_galaxies >= GALAXIES_PER_BIN * n * n]
    n_bins = wanted[0] if wanted else N_BINS[-1]
    edges = np.linspace(*MAGNITUDE_RANGE, n_bins + 1)
    row, column = (
        np.clip(np.searchsorted(edges, galaxies[name], "right") - 1, 0, n_bins - 1)
        for name in ("euclid_mag", "rubin_mag")
    )
    cell = row * n_bins + column

    def table(values):
        return np.bincount(cell, values, n_bins**2).reshape(n_bins, n_bins)

    number = table(np.ones(n_galaxies))

    def mean_and_error(values):
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = table(values) / number
            variance = table((values - mean.ravel()[cell]) ** 2) / (number - 1)
            return mean, np.where(number > 1, np.sqrt(variance / number), np.nan)

    maps = {"edges": edges, "number": number, "mean": {}, "gain": {}, "error": {}}
    for start in starts:
        for mode in MODES:
            maps["mean"][f"{start}-{mode}"] = mean_and_error(galaxies[f"{start}-{mode}"])[0]
        for mode in SINGLES:
            gain = galaxies[f"{start}-joint"] - galaxies[f"{start}-{mode}"]
            name = f"{start}-{mode}"
            maps["gain"][name], maps["error"][name] = mean_and_error(gain)
    return maps


def summarise(galaxies, maps, starts):
    """Numbers of the run for its JSON: medians, shares, means by region, and the maps."""
    bright = [galaxies[name] <= BRIGHT for name in ("euclid_mag", "rubin_mag")]
    summary = {"n_galaxies": len(bright[0]), "starts": {}}
    for start in starts:
        sdr = {mode: galaxies[f"{start}-{mode}"] for mode in MODES}
        better = np.maximum(sdr["euclid"], sdr["rubin"])
        gains = {mode: sdr["joint"] - sdr[mode] for mode in SINGLES}
        gains["better"] = sdr["joint"] - better
        found = {
            "median": {mode: float(np.median(values)) for mode, values in sdr.items()},
            "wins": {name: float((gain > 0).mean()) for name, gain in gains.items()},
            "gain": {name: _mean(gain) for name, gain in gains.items()},
            "regions": {},
        }
        for name, (in_euclid, in_rubin) in REGIONS.items():
            here = (bright[0] == in_euclid) & (bright[1] == in_rubin)
            found["regions"][name] = {
                "n": int(here.sum()),
                "mean": {mode: _mean(values[here])["mean"] for mode, values in sdr.items()},
                "gain": {name: _mean(gain[here]) for name, gain in gains.items()},
            }
        summary["starts"][start] = found
    plain = {name: maps[name].tolist() for name in ("edges", "number")}
    for kind in ("mean", "gain", "error"):
        plain[kind] = {name: np.round(m, 3).tolist() for name, m in maps[kind].items()}
    return summary | {"maps": plain}


def _mean(values):
    """Mean and its standard error; null where there are too few."""
    n = len(values)
    return {
        "mean": float(values.mean()) if n else np.nan,
        "error": float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else np.nan,
    }


def joint(maps, starts, numbers):
    """Findings of section 6, from the maps and the numbers of `summarise`."""
    found = []
    for start in starts:
        of_start = numbers["starts"][start]
        found.append(_where_bright(start, of_start))
        found += [_difference(start, mode, maps, of_start) for mode in SINGLES]
        found.append(_gains(start, of_start))
    return [*found, _wins(numbers)]


def _where_bright(start, found):
    means = {name: region["mean"] for name, region in found["regions"].items()}
    alone = means["bright in Euclid only"], means["bright in Rubin only"]
    own_best = alone[0]["euclid"] > alone[0]["rubin"] and alone[1]["rubin"] > alone[1]["euclid"]
    in_any = all(
        means[name]["joint"] > means["faint in both"]["joint"]
        for name in REGIONS
        if name != "faint in both"
    )
    text = "; ".join(
        f"{name}: Rubin {mean['rubin']:.1f}, Euclid {mean['euclid']:.1f}, joint "
        f"{mean['joint']:.1f} dB"
        for name, mean in means.items()
    )
    return Finding(
        "fig:sdr_per_mag",
        f"SDR by magnitude, {START_NAMES[start]}",
        "Each survey alone is most accurate where sources are bright in it; joint modelling is "
        "accurate where they are bright in any.",
        f"Mean SDRs of galaxies (bright: up to magnitude {BRIGHT:g}): {text}.",
        own_best and in_any,
        f"joint-sdr_per_mag-{start}.png",
    )


def _difference(start, mode, maps, found):
    name = f"{start}-{mode}"
    gain, error, number = maps["gain"][name], maps["error"][name], maps["number"]
    counted = number >= FEWEST
    better, sure = counted & (gain > 0), counted & (np.abs(gain) > CERTAIN * error)
    n, n_better = counted.sum(), better.sum()
    n_worse = (sure & (gain < 0)).sum()
    mean = found["gain"][mode]
    edges = [f"{low:g} - {high:g}" for low, high in zip(maps["edges"][:-1], maps["edges"][1:])]
    table = [["Euclid / Rubin [mag]", *edges]]
    for edge, *columns in zip(edges, gain, error, number):
        cells = [
            "" if not n_here else f"{g:+.1f} ± {e:.1f} ({n_here:.0f})"
            for g, e, n_here in zip(*columns)
        ]
        table.append([edge, *cells])
    return Finding(
        "fig:single_vs_joint",
        f"Joint minus {TITLES[mode]}, {START_NAMES[start]}",
        "Virtually all bins of magnitude show joint modelling to be more accurate.",
        f"Joint modelling is better in {n_better} of {n} bins that hold {FEWEST} galaxies or more, "
        f"beyond {CERTAIN:g} standard errors in {(sure & better).sum()}, and worse beyond them in "
        f"{n_worse}; over all galaxies by {mean['mean']:.2f} ± {mean['error']:.2f} dB. The table "
        "gives the mean difference [dB], its standard error and the number of galaxies.",
        bool(n_better >= VIRTUALLY_ALL * n) if n else None,
        f"joint-single_vs_joint-{start}.png",
        table,
    )


def _gains(start, found):
    """The sentence on where joint modelling gains over the better survey alone, and where not."""
    groups = {"gains": [], "makes no certain difference": [], "loses": []}
    table = [["mean SDR [dB]", "galaxies", *map(str.capitalize, MODES), "joint minus the better"]]
    for name, region in found["regions"].items():
        gain = region["gain"]["better"]
        difference = f"{gain['mean']:+.2f} ± {gain['error']:.2f}"
        means = [f"{region['mean'][mode]:.2f}" for mode in MODES]
        table.append([name, region["n"], *means, difference])
        if region["n"] < FEWEST:
            continue
        sure = abs(gain["mean"]) > CERTAIN * gain["error"]
        verdict = "gains" if gain["mean"] > 0 else "loses"
        group = groups[verdict if sure else "makes no certain difference"]
        group.append(f"{name} ({difference} dB, n = {region['n']})")
    text = "; ".join(
        f"it {verdict} for galaxies {', '.join(names)}"
        for verdict, names in groups.items()
        if names
    )
    mean, over = found["gain"]["better"], found["gain"]
    return Finding(
        "",
        f"Where joint modelling gains, {START_NAMES[start]}",
        "Where joint modelling gains over the better survey alone, and where it does not.",
        f"Against the better survey of each galaxy, which only the truth can tell: {text}. Over "
        f"all galaxies {mean['mean']:+.2f} ± {mean['error']:.2f} dB; against a survey chosen "
        f"beforehand {over['rubin']['mean']:+.2f} dB (Rubin) and {over['euclid']['mean']:+.2f} dB "
        "(Euclid).",
        bool(mean["mean"] > 0) if abs(mean["mean"]) > CERTAIN * mean["error"] else None,
        f"joint-errors-{start}.png",
        table,
    )


def _wins(numbers):
    found = numbers["starts"]["own"]
    median, wins = found["median"], found["wins"]
    return Finding(
        "",
        "Accuracy without knowledge of the truth but positions",
        "Median SDR at least "
        + ", ".join(f"{value:g} dB {mode}" for mode, value in MEDIANS.items())
        + f"; joint better than Euclid alone for {OVER_EUCLID:.0%} of the galaxies, and than the "
        f"better survey alone for {OVER_BETTER:.0%}.",
        f"Over {numbers['n_galaxies']} galaxies the medians are "
        + ", ".join(f"{value:.2f} dB {mode}" for mode, value in median.items())
        + f"; joint is better than Euclid alone for {wins['euclid']:.1%}, than Rubin alone for "
        f"{wins['rubin']:.1%}, than the better of both for {wins['better']:.1%}.",
        all(median[mode] >= value for mode, value in MEDIANS.items())
        and wins["euclid"] >= OVER_EUCLID
        and wins["better"] >= OVER_BETTER,
    )
