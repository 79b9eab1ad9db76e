"""Findings of an accuracy run about section 5: means, their scatter, and GalSim's sinc."""

from __future__ import annotations

import numpy as np

from . import edge_findings
from .edge_findings import pair_text
from .figures import NAMES
from .finding import Claim, Finding

MARGIN = 0.1  # [dB] mean SDRs this near count as equal
SIMILAR = 1.0  # [dB] mean SDRs this near are of similar quality
FLAT = 1.0  # [dB] per doubling of the pixels' ratio: hardly a dependence
FAR = 3.0  # [dB] far better: residuals of half the norm
ORDER_OF_MAGNITUDE = 10.0  # [dB] the residual's norm ten times smaller
QUINTIC_GAIN = 7.0  # [dB] ours above GalSim's default, at least

LEAD = Claim(
    "fig:SDR",
    "Mean SDR of ours and of GalSim's default",
    "In every pair of surveys the scheme is on average more accurate than GalSim's default.",
    "15 of 15 pairs",
)
RESIDUALS = Claim(
    "Sect:conclusion",
    "Size of the residuals",
    "Residuals are typically an order of magnitude smaller than those of GalSim's default.",
    f"{ORDER_OF_MAGNITUDE:g} dB",
)
TREND = Claim(
    "fig:SDR",
    "SDR against the ratio of pixel sizes",
    "The larger the ratio of pixel sizes, the worse GalSim's default; the scheme, being exact, "
    "hardly depends on it.",
    "falls; no dependence",
)
IDENTITY = Claim(
    "fig:SDR_diff",
    "A survey resampled onto itself",
    "The scheme leads by most on the diagonal, where a survey is resampled onto itself: there it "
    "is the identity and GalSim's default is not.",
    "identity",
)
SCATTER = Claim(
    "fig:SDR_diff",
    "Scatter of the SDR",
    "The scheme's SDR scatters widely, in some pairs by more than its mean lead over GalSim's "
    "default.",
    "in some pairs",
)
SINC = Claim(
    "fig:SDR_sinc",
    "GalSim's sinc interpolation",
    "GalSim's sinc is about as accurate as the scheme; clear differences are on the diagonal only.",
    "similar off the diagonal",
)
SINC_IDENTITY = Claim(
    "fig:SDR_sinc",
    "GalSim's sinc on the diagonal",
    "On the diagonal too, GalSim's sinc is far more accurate than its default.",
    "far better",
)
PRECISIONS = {
    method: Claim(
        "",
        f"Off the diagonal, in {precision}",
        f"Every pair is within {MARGIN} dB of GalSim's sinc or above it, and at least "
        f"{QUINTIC_GAIN:g} dB above GalSim's default.",
        f"≥ -{MARGIN} dB; ≥ {QUINTIC_GAIN:g} dB",
    )
    for method, precision in (("ours", "float32"), ("ours64", "float64"))
}
SCHEMES = Claim(
    "",
    "The paper's scheme beside ours",
    f"The paper's scheme is as accurate as ours: off the diagonal, within {MARGIN} dB.",
    "every pair",
)


def findings(name, numbers):
    """Findings of section 5; the numbers are those that `accuracy` writes, `name` its file."""
    pairs = numbers["pairs"]
    off = [pair for pair in pairs if pair["from"] != pair["to"]]
    diagonal = [pair for pair in pairs if pair["from"] == pair["to"]]
    found = [_lead(name, pairs), _residuals(off or pairs)]
    if len(off) > 2:
        found.append(_trend(off))
    if diagonal:
        found.append(_identity(name, off, diagonal))
    if off:
        found += [_scatter(off), _against_sinc(name, off, diagonal)]
    if diagonal:
        found.append(_sinc_identity(diagonal))
    found += edge_findings.findings(name, numbers)
    if off:
        found += [_off_diagonal(off, method) for method in PRECISIONS]
    return [*found, _both_schemes(pairs, off, diagonal)]


def _margins(method, against, of):
    """Mean SDR [dB] of one method minus that of another, for each pair."""
    return [pair["mean"][method] - pair["mean"][against] for pair in of]


def _lead(name, pairs):
    gains = _margins("ours", "quintic", pairs)
    n_better = sum(gain > 0 for gain in gains)
    return Finding(
        LEAD,
        f"{n_better} of {len(pairs)} pairs",
        f"Over {pairs[0]['n_galaxies']} galaxies ours is better on average in {n_better} of "
        f"{len(pairs)} pairs, at least by {min(gains):.2f} dB ({pair_text(pairs[np.argmin(gains)])}"
        ").",
        n_better == len(pairs),
        figure=f"{name}-SDR.png",
    )


def _residuals(pairs):
    gains = _margins("ours", "quintic", pairs)
    typical = float(np.median(gains))
    return Finding(
        RESIDUALS,
        f"{typical:.1f} dB",
        f"Off the diagonal the mean lead over GalSim's default is {min(gains):.1f} to "
        f"{max(gains):.1f} dB, {typical:.1f} dB in the median pair.",
        typical >= ORDER_OF_MAGNITUDE,
    )


def _trend(off):
    """Trend of SDRs with the ratio of pixel sizes; model stamps grow in proportion to it."""
    doublings = np.log2([pair["n_model"] for pair in off])
    quintic, ours, sinc = (
        np.polyfit(doublings, [pair["mean"][method] for pair in off], 1)[0]
        for method in ("quintic", "ours64", "sinc")
    )
    return Finding(
        TREND,
        f"{quintic:+.1f} dB; {ours:+.1f} dB a doubling",
        f"Off the diagonal, each doubling of the ratio changes GalSim's default by {quintic:+.1f} "
        f"dB, ours (float64) by {ours:+.1f} dB, and GalSim's sinc, as exact as ours, by "
        f"{sinc:+.1f} dB.",
        bool(quintic < 0 and abs(ours) < FLAT),
    )


def _identity(name, off, diagonal):
    below = min(_margins("ours", "quintic", diagonal))
    exact = all(pair["exact"]["ours64"] for pair in diagonal)
    return Finding(
        IDENTITY,
        f"{'' if exact else 'not '}bit for bit, in float64",
        f"On the diagonal, ours in float64 is {'' if exact else 'not '}exact, bit for bit; in "
        f"float32 it is above GalSim's default by {below:.1f} dB or more, at the truth rounded to "
        "float32.",
        exact and below > max(_margins("ours", "quintic", off), default=0),
        figure=f"{name}-SDR_diff.png",
    )


def _scatter(off):
    gains = _margins("ours", "quintic", off)
    n_wide = sum(pair["std"]["ours"] > gain for pair, gain in zip(off, gains))
    return Finding(
        SCATTER,
        f"{n_wide} of {len(off)} pairs",
        f"The standard deviation of ours exceeds the mean lead in {n_wide} of {len(off)} pairs off "
        "the diagonal.",
        n_wide > 0,
        better=all(gain > 0 for gain in gains),  # the lead is above its scatter
    )


def _against_sinc(name, off, diagonal):
    margins = _margins("ours64", "sinc", off)
    apart = max(map(abs, margins))
    identity = _margins("ours", "sinc", diagonal)
    on_it = ""
    if identity:
        on_it = f", and on it ours in float32 is better by {min(identity):.1f} dB or more"
    return Finding(
        SINC,
        f"within {apart:.2f} dB",
        f"Off the diagonal the means differ by {apart:.2f} dB at most in float64{on_it}.",
        apart < SIMILAR and all(margin > apart for margin in identity),
        better=min(margins) > -SIMILAR and all(margin > 0 for margin in identity),
        figure=f"{name}-SDR_sinc.png",
    )


def _sinc_identity(diagonal):
    low, pair = min(zip(_margins("sinc", "quintic", diagonal), map(pair_text, diagonal)))
    return Finding(
        SINC_IDENTITY,
        f"{low:.1f} dB or more",
        f"On the diagonal, GalSim's sinc is above its default by {low:.1f} dB or more ({pair}).",
        low >= FAR,
    )


def _off_diagonal(off, method):
    margins, gains = _margins(method, "sinc", off), _margins(method, "quintic", off)
    low, pair = min(zip(margins, map(pair_text, off)))
    loss, where = min(zip(_margins(method, "ours64", off), map(pair_text, off)))
    return Finding(
        PRECISIONS[method],
        f"{low:+.2f} dB; {min(gains):.1f} dB",
        f"Ours minus sinc is {low:+.2f} dB ({pair}) to {max(margins):+.2f} dB, ours minus GalSim's "
        f"default {min(gains):.1f} to {max(gains):.1f} dB.",
        low >= -MARGIN and min(gains) >= QUINTIC_GAIN,
        more=f"To float64 it loses {-loss:.2f} dB at most ({where})." if loss else "",
    )


def _both_schemes(pairs, off, diagonal):
    """Ours and the paper's scheme, both in float32, and the table of all methods."""
    gains = list(zip(_margins("paper", "ours", off), map(pair_text, off)))
    apart = [f"{pair} ({gain:+.2f} dB)" for gain, pair in gains if abs(gain) > MARGIN]
    same = _margins("paper", "ours", diagonal)
    number = f"{len(off) - len(apart)} of {len(off)} pairs"
    head = ["from → to", "N", *NAMES.values(), "GalSim quintic wins"]
    rows = [
        [
            pair_text(pair),
            pair["n_model"],
            *(_spread(pair, method) for method in NAMES),
            f"{pair['quintic_wins']:.1%}",
        ]
        for pair in pairs
    ]
    return Finding(
        SCHEMES,
        number,
        f"The paper's scheme minus ours, both in float32, is within {MARGIN} dB in {number} off "
        "the diagonal"
        + (f", not in {', '.join(apart)}" * bool(apart))
        + (f"; on it {min(same):.1f} to {max(same):.1f} dB" if same else "")
        + ".",
        not apart,
        better=all(gain <= MARGIN for gain, _ in gains),
        more="The table gives each method's mean ± standard deviation of the SDR [dB].",
        table=[head, *rows],
    )


def _spread(pair, method):
    if pair["exact"][method]:
        return "exact"
    return f"{pair['mean'][method]:.2f} ± {pair['std'][method]:.2f}"
