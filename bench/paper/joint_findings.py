"""Findings of the joint fits about section 6."""

from __future__ import annotations

import numpy as np

from ..harness.scenes import MODES
from .finding import Claim, Finding
from .joint_bins import BRIGHT, REGIONS, SINGLES

NAMES = {"rubin": "Rubin", "euclid": "Euclid", "joint": "joint"}
TITLES = {"rubin": "Rubin alone", "euclid": "Euclid alone"}
# Bins with fewer galaxies have a mean, but their differences do not count.
FEWEST = 5
# Standard errors beyond which a difference counts as certain.
CERTAIN = 2.0
VIRTUALLY_ALL = 0.9  # of the bins
ORDER_OF_MAGNITUDE = 10.0  # [dB] the residual's norm ten times smaller
OVER_EUCLID, OVER_BETTER = 0.70, 0.50  # shares of the galaxies that joint fits are asked to win
MEDIANS = {"euclid": 5.7, "joint": 7.0}  # [dB] asked of fits without knowledge of the truth

BRIGHTNESS = Claim(
    "fig:sdr_per_mag",
    "SDR by magnitude",
    "A survey alone is most accurate for sources that are bright in it, both together for sources "
    "that are bright in either.",
    "in every such group",
)
DIFFERENCE = {
    mode: Claim(
        "fig:single_vs_joint",
        f"Joint minus {title}",
        f"Modelling both surveys together is more accurate than {title} in nearly every bin of "
        "magnitude.",
        "virtually all bins",
    )
    for mode, title in TITLES.items()
}
LARGEST = Claim(
    "fig:single_vs_joint",
    "The largest gain",
    "Where one survey sees a source much brighter than the other, joint modelling gains up to an "
    "order of magnitude over the other alone.",
    f"{ORDER_OF_MAGNITUDE:g} dB",
)
GAIN = Claim(
    "",
    "Where joint modelling gains",
    "Joint modelling is more accurate than the better survey alone, which only the truth can name.",
    "above 0 dB",
)
UNKNOWN_TRUTH = Claim(
    "",
    "Accuracy without knowledge of the truth but positions",
    "Fits that start from positions alone reach these median SDRs, and joint ones beat Euclid "
    f"alone for {OVER_EUCLID:.0%} of the galaxies and the better survey alone for "
    f"{OVER_BETTER:.0%}.",
    ", ".join(f"{NAMES[mode]} {value:g} dB" for mode, value in MEDIANS.items())
    + f"; {OVER_EUCLID:.0%}, {OVER_BETTER:.0%}",
)


def findings(start, numbers):
    """Findings of section 6 for the fits of one start; the numbers are those of `summarise`."""
    maps = {
        kind: {name: np.array(table, float) for name, table in numbers["maps"][kind].items()}
        for kind in ("gain", "error")
    }
    maps |= {name: np.array(numbers["maps"][name]) for name in ("edges", "number")}
    of_start = numbers["starts"][start]
    found = [
        _where_bright(start, of_start),
        *(_difference(start, mode, maps, of_start) for mode in SINGLES),
        _largest(start, maps, numbers["starts"]),
        _gains(start, of_start),
    ]
    return [*found, _unknown_truth(numbers)] if start == "own" else found


def _where_bright(start, found):
    means = {name: region["mean"] for name, region in found["regions"].items()}
    alone = means["bright in Euclid only"], means["bright in Rubin only"]
    own_best = alone[0]["euclid"] > alone[0]["rubin"], alone[1]["rubin"] > alone[1]["euclid"]
    in_any = [
        means[name]["joint"] > means["faint in both"]["joint"]
        for name in REGIONS
        if name != "faint in both"
    ]
    text = "; ".join(
        f"{name}: Rubin {mean['rubin']:.1f}, Euclid {mean['euclid']:.1f}, joint "
        f"{mean['joint']:.1f} dB"
        for name, mean in means.items()
    )
    return Finding(
        BRIGHTNESS,
        f"{sum(own_best)} of 2 groups alone; {sum(in_any)} of 3 together",
        f"Mean SDRs of galaxies (bright: up to magnitude {BRIGHT:g}): {text}.",
        all(own_best) and all(in_any),
        figure=f"joint-sdr_per_mag-{start}.png",
    )


def _difference(start, mode, maps, found):
    name = f"{start}-{mode}"
    gain, error, number = maps["gain"][name], maps["error"][name], maps["number"]
    counted = number >= FEWEST
    better, sure = counted & (gain > 0), counted & (np.abs(gain) > CERTAIN * error)
    n, n_better = counted.sum(), better.sum()
    n_worse = (sure & (gain < 0)).sum()
    mean = found["gain"][mode]
    return Finding(
        DIFFERENCE[mode],
        f"{n_better} of {n} bins",
        f"Joint modelling is better in {n_better} of {n} bins that hold {FEWEST} galaxies or more, "
        f"beyond {CERTAIN:g} standard errors in {(sure & better).sum()}, and worse beyond them in "
        f"{n_worse}; over all galaxies it gains {mean['mean']:+.2f} ± {mean['error']:.2f} dB.",
        bool(n_better >= VIRTUALLY_ALL * n) if n else None,
        more="The table gives the mean difference [dB], its standard error and the number of "
        "galaxies.",
        figure=f"joint-single_vs_joint-{start}.png",
        table=_difference_table(maps["edges"], gain, error, number),
    )


def _difference_table(edges, gain, error, number):
    names = [f"{low:g} - {high:g}" for low, high in zip(edges[:-1], edges[1:])]
    table = [["Euclid / Rubin [mag]", *names]]
    for name, *columns in zip(names, gain, error, number):
        cells = [
            "" if not n_here else f"{g:+.2f} ± {e:.2f} ({n_here:.0f})"
            for g, e, n_here in zip(*columns)
        ]
        table.append([name, *cells])
    return table


def _largest(start, maps, starts):
    """The largest mean gains, and what a start from the truth leaves to gain."""
    counted, edges = maps["number"] >= FEWEST, maps["edges"]
    largest, texts = [], []
    for mode in SINGLES:
        gain = np.where(counted, maps["gain"][f"{start}-{mode}"], -np.inf)
        row, column = np.unravel_index(gain.argmax(), gain.shape)
        largest.append(gain[row, column])
        texts.append(
            f"{gain[row, column]:.1f} dB over {TITLES[mode]} (magnitude {edges[row]:g} to "
            f"{edges[row + 1]:g} in Euclid, {edges[column]:g} to {edges[column + 1]:g} in Rubin)"
        )
    known = bool(counted.any())
    return Finding(
        LARGEST,
        " and ".join(f"{gain:.1f} dB" for gain in largest) if known else "too few galaxies",
        f"The largest mean gains of a bin are {' and '.join(texts)}{_head_start(start, starts)}."
        if known
        else f"No bin holds {FEWEST} galaxies.",
        bool(max(largest) >= ORDER_OF_MAGNITUDE) if known else None,
    )


def _head_start(start, starts):
    if start != "sersic" or "own" not in starts:
        return ""
    region = "bright in Euclid only"
    here, own = (starts[name]["regions"][region]["mean"]["rubin"] for name in ("sersic", "own"))
    return (
        f"; a start fitted to the truth knows what a survey does not see: for galaxies {region}, "
        f"Rubin alone makes {here:.1f} dB from it and {own:.1f} dB from positions alone"
    )


def _gains(start, found):
    """Regions in which joint modelling gains over the better survey alone, and the others."""
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
        outcome = "gains" if gain["mean"] > 0 else "loses"
        group = groups[outcome if sure else "makes no certain difference"]
        group.append(f"{name} ({difference} dB, n = {region['n']})")
    text = "; ".join(
        f"it {outcome} for galaxies {', '.join(names)}"
        for outcome, names in groups.items()
        if names
    )
    mean, over = found["gain"]["better"], found["gain"]
    over_all = f"{mean['mean']:+.2f} ± {mean['error']:.2f} dB"
    return Finding(
        GAIN,
        over_all,
        f"Against the better survey of each galaxy, {text or 'there are too few to say'}.",
        bool(mean["mean"] > 0) if abs(mean["mean"]) > CERTAIN * mean["error"] else None,
        more=f"Over all galaxies {over_all}; against a survey chosen beforehand "
        f"{over['rubin']['mean']:+.2f} dB (Rubin) and {over['euclid']['mean']:+.2f} dB (Euclid).",
        figure=f"joint-errors-{start}.png",
        table=table,
    )


def _unknown_truth(numbers):
    found = numbers["starts"]["own"]
    median, wins = found["median"], found["wins"]
    return Finding(
        UNKNOWN_TRUTH,
        ", ".join(f"{NAMES[mode]} {median[mode]:.2f} dB" for mode in MEDIANS)
        + f"; {wins['euclid']:.1%}, {wins['better']:.1%}",
        f"Over {numbers['n_galaxies']} galaxies the medians are "
        + ", ".join(f"{NAMES[mode]} {value:.2f} dB" for mode, value in median.items())
        + f"; joint is better than Euclid alone for {wins['euclid']:.1%}, than Rubin alone for "
        f"{wins['rubin']:.1%}, than the better of both for {wins['better']:.1%}.",
        all(median[mode] >= value for mode, value in MEDIANS.items())
        and wins["euclid"] >= OVER_EUCLID
        and wins["better"] >= OVER_BETTER,
    )
