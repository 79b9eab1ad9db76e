"""What a timing run says about section 4: sentences and verdicts made from its numbers."""

from __future__ import annotations

import numpy as np

from .figures import line_text
from .report import Finding

PAPER_FIT = (-0.17, 0.048)  # time of the paper's code over GalSim's default: intercept, slope in M
LINEAR_R2 = 0.9  # share of the variance that a straight line explains, to be called linear
COMPARABLE = 2.0  # times within this factor are called comparable
SLOPES = {"paper": (3.5, 4.5), "ours": (0.0, 3.3)}  # near 4; near 3 or below
SLOPE_FROM = 100  # model pixels a side: below, kernel launches hide the growth


def line_fit(rows, scheme):
    """Straight line through times over GalSim's default against M: (intercept, slope), R^2."""
    m = np.array([row["n_obs"] for row in rows], float)
    ratio = np.array([row["ms"][scheme] / row["ms"]["quintic"] for row in rows])
    slope, intercept = np.polyfit(m, ratio, 1)
    left = np.var(ratio - intercept - slope * m)
    return (float(intercept), float(slope)), float(1 - left / np.var(ratio))


def slope(sizes, times):
    """Slope of log time in log N, over the sizes from SLOPE_FROM on; None with fewer than two."""
    large = [(np.log(n), np.log(t)) for n, t in zip(sizes, times) if n >= SLOPE_FROM]
    return float(np.polyfit(*zip(*large), 1)[0]) if len(large) > 1 else None


def findings(rows, schemes, sizes, means):
    """Findings of section 4; the numbers are those that `timing` writes.

    rows: aligned survey pairs; schemes: both schemes on the main pair, a row for each angle
    sizes, means: mean times [ms] of each method by size
    """
    fits = {scheme: line_fit(rows, scheme)[0] for scheme in ("paper", "ours")}
    r2 = line_fit(rows, "paper")[1]
    yield Finding(
        "fig:time_ratios(M)",
        "Time over GalSim's default against M",
        f"The time of the paper's scheme over GalSim's default is well described by a straight "
        f"line, {PAPER_FIT[0]} + {PAPER_FIT[1]} M.",
        f"The paper's scheme, on OpenCL: {line_text(*fits['paper'])} (R² = {r2:.2f}); its slope is "
        f"{fits['paper'][1] / PAPER_FIT[1]:.2f} of the paper's. Ours: {line_text(*fits['ours'])}.",
        r2 >= LINEAR_R2,
        "timing-time_ratios.png",
    )
    below = [n for n, p, s in zip(sizes, means["paper"], means["sinc"]) if n < 200 and p < s]
    small = [n for n in sizes if n < 200]
    large = [p / s for n, p, s in zip(sizes, means["paper"], means["sinc"]) if n >= 200]
    ours = [g / t for g, t in zip(means["quintic"], means["ours"])]
    yield Finding(
        "fig:absolute_timings",
        "Mean times of all methods",
        "The scheme is faster than GalSim's sinc below N = 200, and comparable above.",
        f"The paper's scheme is faster than GalSim's sinc at {len(below)} of {len(small)} sizes "
        "below 200"
        + (f", and takes {large[-1]:.2f} of its time at {sizes[-1]}" if large else "")
        + f". Ours is {min(ours):.0f} to {max(ours):.0f} times faster than GalSim's default.",
        len(below) == len(small) and all(1 / COMPARABLE < ratio < COMPARABLE for ratio in large),
        "timing-absolute_timings.png",
    )
    table = [["angle", "N", "ours [ms]", "the paper's [ms]", "ratio"]]
    slopes, texts = [], []
    for row in schemes:
        angle, n_models, ours, paper = (
            row[name] for name in ("angle_deg", "n_model", "ours", "paper")
        )
        table += [
            [f"{angle:g}°", n, f"{o:.3f}", f"{p:.3f}", f"{p / o:.1f}"]
            for n, o, p in zip(n_models, ours, paper)
        ]
        found = {"paper": slope(n_models, paper), "ours": slope(n_models, ours)}
        if None not in found.values():
            slopes.append(found)
            texts.append(f"{found['paper']:.2f} and {found['ours']:.2f} at {angle:g}°")
            products = slope(n_models, row["products"])
            texts[-1] += f" ({products:.2f} by the count of the paper's multiply-adds)"
    yield Finding(
        "",
        "Ours over the paper's scheme",
        "The paper's scheme grows with a slope near 4 in N, ours near 3 or below.",
        f"Log-log slopes from N = {SLOPE_FROM} on, the paper's and ours: "
        f"{'; '.join(texts) or 'too few sizes'}.",
        all(low <= s[m] <= high for s in slopes for m, (low, high) in SLOPES.items())
        if slopes
        else None,
        "timing-schemes.png",
        table,
    )
