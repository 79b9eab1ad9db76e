"""Resources for whole surveys, computed from measured figures: the tables of docs/scale.md.

    python -m bench.on_paper [--write]

The figures are read from the table between the marks "measured" in docs/scale.md, a figure a line;
what follows from them is printed, and with --write put between the marks "arithmetic" there.
"""

from __future__ import annotations

import re

from .harness.options import ROOT, Parser, run

PAGE = ROOT / "docs" / "scale.md"
ARCMIN2_PER_DEG2 = 3600
# name, area [arcmin^2], objects (None = by our density)
AREAS = (
    ("Rubin patch, 10' x 10'", 100.0, None),
    ("Euclid tile, core of 30' x 30'", 900.0, 85_000),
    ("14,000 square degrees, our density", 14_000 * ARCMIN2_PER_DEG2, None),
    ("14,000 square degrees, Euclid's", 14_000 * ARCMIN2_PER_DEG2, 56_000 * 85_000),
)
HEAD = (
    "| | objects | core-hours | core-seconds | catalogue | models | mosaics |\n"
    "|---|---|---|---|---|---|---|\n"
)


def measured(text):
    """{name: figure} of the lines "| name | figure | ... |" between the marks."""
    lines = re.findall(r"^\| ([^|]+?) \| ([0-9.]+) \|", between(text, "measured"), re.MULTILINE)
    return {name: float(figure) for name, figure in lines}


def between(text, mark):
    """The text between the marks."""
    return text.partition(f"<!-- {mark} -->\n")[2].partition(f"<!-- end of {mark} -->")[0]


def arithmetic(figures):
    """The table of what areas of sky take."""
    per_source, per_px = figures["core-seconds a source"], figures["bytes a model pixel, mosaics"]
    density = figures["sources a square arcminute"]
    pixels = (60 / figures["arcseconds a model pixel"]) ** 2
    lines = []
    for name, area, objects in AREAS:
        n = density * area if objects is None else objects
        core_s = n * per_source
        sizes = [
            n * figures["bytes a source, catalogue"],
            n * figures["bytes a source, models"],
            area * pixels * per_px,
        ]
        cells = [name, _short(n), _short(core_s / 3600), _short(core_s), *map(_bytes, sizes)]
        lines.append(f"| {' | '.join(cells)} |\n")
    return HEAD + "".join(lines)


def _short(value):
    """A number to two digits, with thousands."""
    digits = f"{value:.1e}"
    return f"{float(digits):,.0f}" if value >= 10 else f"{float(digits):g}"


def _bytes(value):
    units = "kB", "MB", "GB", "TB"
    power = next((p for p in range(1, 4) if value < 1000 ** (p + 1)), 4)
    return f"{_short(value / 1000**power)} {units[power - 1]}"


def main(options):
    text = PAGE.read_text()
    table = arithmetic(measured(text))
    print(table, end="")
    if options.write:
        mark = "<!-- arithmetic -->\n"
        PAGE.write_text(text.replace(mark + between(text, "arithmetic"), mark + table))


def parser():
    parser = Parser(__doc__)
    parser.add_flag("write", "into docs/scale.md")
    return parser


if __name__ == "__main__":
    run(main, parser())
