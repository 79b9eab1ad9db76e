"""Pieces of HTML; all texts from files are escaped here."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from html import escape
from pathlib import Path

PAGE = Path(__file__).parent / "page"
# in this order, as one script
SCRIPTS = (
    *("pixels.js", "shades.js", "view.js", "overlays.js", "source.js", "table.js", "chart.js"),
    *("save.js", "page.js"),
)
EMPTY = "–"


def format_number(value, form=".4g") -> str:
    """A number as text, with a proper minus; EMPTY for NaN and None."""
    if value is None or not math.isfinite(value):
        return EMPTY
    return format(float(value), form).replace("-", "−")


def table(caption, heads, rows, *, sort=False, link=None) -> str:
    """A table.

    heads: (title, unit, kind) of each column, kind "n" for numbers, "long" for long texts, or ""
    rows: texts; sort: whether a script may sort it; link: index of the column with sources' ids
    """
    if not rows:
        return ""
    head = "".join(
        f'<th scope="col"{_class(kind)}>{escape(title)}'
        + (f"<small>{escape(unit)}</small>" if unit else "")
        + "</th>"
        for title, unit, kind in heads
    )
    mark = " data-source"
    body = "".join(
        "<tr>"
        + "".join(
            f"<td{_class(heads[i][2])}{mark if i == link else ''}>{escape(str(cell))}</td>"
            for i, cell in enumerate(row)
        )
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}">'
        f"<table{' data-sort' if sort else ''}><caption>{escape(caption)}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _class(kind):
    return f' class="{kind}"' if kind else ""


def charts(figures, more="") -> str:
    """Figures (title, svg, remark) beside each other, and HTML beside them."""
    return (
        '<div class="charts">'
        + "".join(
            f"<figure><figcaption>{escape(title)} <small>{escape(remark)}</small></figcaption>"
            f"{svg}</figure>"
            for title, svg, remark in figures
        )
        + f"{more}</div>"
    )


def section(name, title, *parts) -> str:
    """A section of the page."""
    return f'<section id="{name}"><h2>{escape(title)}</h2>{"".join(parts)}</section>'


def text(words, kind="about") -> str:
    """A paragraph."""
    return f"<p{_class(kind)}>{escape(words)}</p>"


def definition_table(pairs) -> str:
    """Table of terms and values, in two columns."""
    inner = "".join(
        f"<dt>{escape(str(what))}</dt><dd>{escape(str(value))}</dd>" for what, value in pairs
    )
    return f'<dl class="facts">{inner}</dl>'


def data_block(name, data) -> str:
    """Data for the script: nothing in it can end the element or begin another one."""
    written = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for character in "<>&":
        written = written.replace(character, f"\\u{ord(character):04x}")
    return f'<script type="application/json" id="{name}">{written}</script>'


def page(title, body, data) -> str:
    """The whole page, with a policy that permits this script alone and loads nothing."""
    style = (PAGE / "report.css").read_text()
    script = "\n".join((PAGE / name).read_text() for name in SCRIPTS)
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{_digest(style)}'; "
        f"script-src 'sha256-{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="generator" content="clresample report">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>{body}"
        f"{data_block('field-data', data)}<script>{script}</script></body></html>\n"
    )


def _digest(content):
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
