"""Findings of an accuracy run about single stamps: residuals, and pairs that GalSim wins."""

from __future__ import annotations

from .finding import Claim, Finding

# The survey pairs in which the paper finds GalSim's default better in up to ~10 % of the galaxies,
# and its share elsewhere.
EDGE_PAIRS = {("HSC", "RUBIN"), ("ROMAN", "HSC"), ("ROMAN", "RUBIN")}
EDGE_SHARE, OTHER_SHARE = 0.10, 0.01

VISUAL = Claim(
    "fig:visual",
    "Resampled images and their residuals",
    "Residuals, looked at by eye, agree with the SDRs.",
    "smaller residuals",
)
WINS = Claim(
    "fig:visual_edge",
    "Where GalSim's default wins",
    "GalSim's default is the better one for fewer than about 10 % of the galaxies from HSC to "
    "Rubin, Roman to HSC and Roman to Rubin, and for fewer than 1 % in the other pairs.",
    f"{EDGE_SHARE:.0%}; {OTHER_SHARE:.0%}",
)
EDGE = Claim(
    "fig:visual_edge",
    "Why GalSim's default wins there",
    "Light that the edge of the stamp cuts off is the reason, and padding the stamp mitigates it.",
    "the edge; padding helps",
)


def findings(name, numbers):
    """Findings on single stamps; the numbers are those that `accuracy` writes, `name` its file."""
    return [
        _visual(name, numbers["visual"]),
        _wins(name, numbers["pairs"]),
        _reason(name, numbers["worst"], numbers["edge_correlation"]),
    ]


def _visual(name, cases):
    better = [case["ours"] > case["quintic"] for case in cases]
    texts = [
        f"{case['title']} {case['ours']:.1f} dB, GalSim {case['quintic']:.1f} dB" for case in cases
    ]
    return Finding(
        VISUAL,
        f"in {sum(better)} of {len(better)} pairs",
        f"A galaxy of median SDR: {'; '.join(texts)}.",
        all(better),
        figure=f"{name}-visual.png",
    )


def pair_text(row):
    """A row's survey pair."""
    return f"{row['from']} → {row['to']}"


def _wins(name, pairs):
    most = {True: 0.0, False: 0.0}  # largest share, in the paper's three pairs and elsewhere
    beyond = []
    for pair in pairs:
        listed, share = (pair["from"], pair["to"]) in EDGE_PAIRS, pair["quintic_wins"]
        most[listed] = max(most[listed], share)
        if share > (EDGE_SHARE if listed else OTHER_SHARE):
            beyond.append(f"{pair_text(pair)} {share:.1%}")
    return Finding(
        WINS,
        f"{most[True]:.1%}; {most[False]:.1%}",
        f"GalSim's default is better in {most[True]:.1%} of the images at most in these three "
        f"pairs and in {most[False]:.1%} at most in the others; beyond the paper's shares: "
        f"{', '.join(beyond) or 'none'}.",
        not beyond,
        figure=f"{name}-visual_edge.png",
    )


def _reason(name, worst, correlation):
    """Light cut off at the edge, or light that GalSim's drawing folds in?  Gains of undoing each.

    worst: the stamps in which ours does worst against GalSim's default, as `accuracy` writes them
    """
    first = [case["padded"][0] for case in worst]
    padding = [case["padded"][-1]["ours"] - row["ours"] for case, row in zip(worst, first)]
    drawing = [case["wide"]["ours"] - row["ours"] for case, row in zip(worst, first)]
    ahead = sum(case["padded"][-1]["ours"] > case["padded"][-1]["quintic"] for case in worst)
    sides = [row["n_model"] / first[0]["n_model"] for row in worst[0]["padded"]]
    lost = [row["quintic"] > row["ours"] for row in first]
    edge = [gain > max(0, other) for gain, other in zip(padding, drawing)]
    # where GalSim wins nowhere, the nearest cases decide
    deciding = [at_edge for at_edge, is_lost in zip(edge, lost) if is_lost or not any(lost)]
    return Finding(
        EDGE,
        f"the edge in {sum(edge)} of {len(edge)}; padding puts ours ahead in {ahead}",
        f"Of the {len(worst)} stamps in which ours does worst against GalSim's default, light cut "
        f"off at the edge is the reason in {sum(edge)} and light folded into the drawn images in "
        f"{len(edge) - sum(edge)}; a model stamp padded {sides[-1]:.2g} times puts ours ahead in "
        f"{ahead}.",
        all(deciding) and ahead == len(worst),
        more=f"Padding changes the SDR of ours by {_list(padding)} dB. Stamps of the first size, "
        "their edge where it was, but cut from wide drawings so that the drawing's FFT folds no "
        f"far light back in, change it by {_list(drawing)} dB; the larger of both gains names the "
        f"reason. GalSim's default is ahead in {sum(lost)} of these stamps, the edge being the "
        f"reason in {sum(e for e, is_lost in zip(edge, lost) if is_lost)}. Over all stamps off the "
        "diagonal, the SDR of ours and the logarithm of the light in the model stamp's outermost "
        f"pixels have a correlation of {correlation:.2f}. The table gives SDRs [dB], ours / "
        "GalSim's default.",
        figure=f"{name}-edges.png",
        table=_cases_table(worst, sides),
    )


def _cases_table(worst, sides):
    heads = [f"stamp x {side:.2g}" for side in sides] + ["stamp x 1, drawn wide"]
    rows = [
        [
            pair_text(case),
            case["galaxy"],
            f"{case['padded'][0]['edge']:.1e}",
            f"{case['edge_rank']:.0%}",
            *(f"{r['ours']:.1f} / {r['quintic']:.1f}" for r in (*case["padded"], case["wide"])),
        ]
        for case in worst
    ]
    return [["from → to", "galaxy", "edge light", "its rank", *heads], *rows]


def _list(values):
    return ", ".join(f"{value:+.1f}" for value in values)
