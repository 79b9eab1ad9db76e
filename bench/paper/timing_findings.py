"""Findings of a timing run about section 4."""

from __future__ import annotations

import numpy as np

from .figures import line_text
from .finding import Claim, Finding

PAPER_FIT = (-0.17, 0.048)  # time of the paper's code over GalSim's default: intercept, slope in M
LINEAR_R2 = 0.9  # share of the variance that a straight line explains, to be called linear
COMPARABLE = 2.0  # factor within which times are called comparable
# Time of the paper's code over GalSim's default, by N [model pixels a side].
PAPER_RATIOS = {50: 1.0, 200: 10.0}
SLOPES = {"paper": (3.5, 4.5), "ours": (0.0, 3.3)}  # near 4; near 3 or below
SLOPE_FROM = 100  # [model pixels a side] below, kernel launches hide the growth

LINE = Claim(
    "fig:time_ratios(M)",
    "Time over GalSim's default against M",
    "The scheme's time over that of GalSim's default grows along a straight line with M, the "
    "observed pixels a side.",
    line_text(*PAPER_FIT),
)
SINC = Claim(
    "fig:absolute_timings",
    "Time beside GalSim's sinc",
    "The scheme is faster than GalSim's sinc for model stamps of N < 200 pixels a side, and about "
    "as fast for larger ones.",
    "faster below N = 200, comparable from there",
)
QUINTIC = Claim(
    "Sect:conclusion",
    "Time beside GalSim's default",
    "The scheme is about as fast as GalSim's default on stamps of 50 pixels a side, and some ten "
    "times slower on stamps of 200.",
    " and ".join(f"{ratio:g}" for ratio in PAPER_RATIOS.values())
    + f" times, at N = {' and '.join(map(str, PAPER_RATIOS))}",
)
GROWTH = Claim(
    "",
    "Growth of both schemes with N",
    "The time of the paper's scheme grows with N at a log-log slope near 4, ours near 3 or below.",
    f"{SLOPES['paper'][0]} to {SLOPES['paper'][1]}; up to {SLOPES['ours'][1]}",
)


def findings(numbers):
    """Findings of section 4; the numbers are those that `timing` writes."""
    rows = numbers["rows"]
    sizes, times = means(rows, "ms")
    return [
        _line(rows),
        _beside_sinc(sizes, times),
        _beside_quintic(sizes, times),
        _growth(numbers["schemes"]),
    ]


def means(rows, kind):
    """Sizes, and mean times [ms] by method over the pairs of each size."""
    sizes = sorted({row["n_model"] for row in rows})
    return sizes, {
        name: [float(np.mean([r[kind][name] for r in rows if r["n_model"] == n])) for n in sizes]
        for name in rows[0][kind]
    }


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


def _line(rows):
    fit, r2 = line_fit(rows, "paper")
    return Finding(
        LINE,
        line_text(*fit),
        f"The paper's scheme, here on OpenCL, follows {line_text(*fit)} (R² = {r2:.2f}), of "
        f"{fit[1] / PAPER_FIT[1]:.2f} times the paper's slope, and ours "
        f"{line_text(*line_fit(rows, 'ours')[0])}.",
        r2 >= LINEAR_R2,
        figure="timing-time_ratios.png",
    )


def _beside_sinc(sizes, times):
    ratios = [(n, p / s) for n, p, s in zip(sizes, times["paper"], times["sinc"])]
    small = [ratio for n, ratio in ratios if n < 200]
    large = [(n, ratio) for n, ratio in ratios if n >= 200]
    n_faster = sum(ratio < 1 for ratio in small)
    at_end = f", and takes {large[-1][1]:.2f} of its time at {large[-1][0]}" if large else ""
    return Finding(
        SINC,
        f"faster at {n_faster} of {len(small)} sizes below 200"
        + (f", {large[-1][1]:.2f} of its time at {large[-1][0]}" if large else ""),
        f"The paper's scheme is faster than GalSim's sinc at {n_faster} of {len(small)} sizes "
        f"below 200{at_end}.",
        n_faster == len(small) and all(1 / COMPARABLE < r < COMPARABLE for _, r in large),
        better=n_faster == len(small) and all(r < COMPARABLE for _, r in large),
        figure="timing-absolute_timings.png",
    )


def _beside_quintic(sizes, times):
    found = {n: p / q for n, p, q in zip(sizes, times["paper"], times["quintic"])}
    ours = [q / t for q, t in zip(times["quintic"], times["ours"])]
    over = {n: found[n] / ratio for n, ratio in PAPER_RATIOS.items() if n in found}
    whole = len(over) == len(PAPER_RATIOS)
    text = " and ".join(f"{found[n]:.2g} times as long at N = {n}" for n in over)
    return Finding(
        QUINTIC,
        " and ".join(f"{found[n]:.2g}" for n in over) + " times" if over else "not measured",
        f"Beside GalSim's default, the paper's scheme takes {text or 'times not measured'}; ours "
        f"is {min(ours):.0f} to {max(ours):.0f} times faster than it.",
        all(1 / COMPARABLE < r < COMPARABLE for r in over.values()) if whole else None,
        better=all(r < COMPARABLE for r in over.values()),
    )


def _growth(schemes):
    table = [["angle", "N", "ours [ms]", "the paper's [ms]", "ratio"]]
    found, texts = [], []
    for row in schemes:
        angle, n_models, ours, paper = (
            row[name] for name in ("angle_deg", "n_model", "ours", "paper")
        )
        table += [
            [f"{angle:g}°", n, f"{o:.3f}", f"{p:.3f}", f"{p / o:.1f}"]
            for n, o, p in zip(n_models, ours, paper)
        ]
        of = {name: slope(n_models, row[name]) for name in ("paper", "ours", "products")}
        if None not in of.values():
            found.append(of)
            texts.append(
                f"{of['paper']:.2f} and {of['ours']:.2f} at {angle:g}° ({of['products']:.2f} by "
                "the count of the paper's multiply-adds)"
            )
    within = all(low <= of[m] <= high for of in found for m, (low, high) in SLOPES.items())
    slower = all(of[m] <= SLOPES[m][1] for of in found for m in SLOPES)
    return Finding(
        GROWTH,
        "; ".join(f"{of['paper']:.2f} and {of['ours']:.2f}" for of in found) or "too few sizes",
        f"Log-log slopes from N = {SLOPE_FROM} on, the paper's and ours: "
        f"{'; '.join(texts) or 'too few sizes'}"
        + ("; no time grows faster than asked" * slower if found else "")
        + ".",
        within if found else None,
        better=slower,
        figure="timing-schemes.png",
        table=table,
    )
