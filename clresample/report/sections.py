"""The sections of the page that are written here: numbers, tables and figures."""

from __future__ import annotations

import json
from collections import Counter
from html import escape

import numpy as np

from .charts import (
    CHI2_ENDS,
    chi2_maps,
    chi2_palette,
    completeness,
    fit_times,
    number_counts,
    pull_charts,
    signal_to_noise,
)
from .html import PAGE, charts, definition_table, format_number, section, table, text
from .page_data import FAILED, FLAGGED, flag_names, order_of, source_states
from .stamps import plain
from .table import columns_of
from .truth import EDGE_PX, FOUND_PX

MAX_ROWS = 500  # of the table of sources, to keep the page fast; the catalogue has all of them
FILTERS = (PAGE / "filters.html").read_text()
SLOWEST, MAX_FAILED = 15, 200


def heading(run, area_arcmin2) -> str:
    """Title, instruments, main numbers, and missing parts."""
    state = source_states(run)
    what = " + ".join(f"{i.name} ({', '.join(i.channels)})" for i in run.instruments)
    numbers = [(f"{len(run.sources):,}", "sources"), (f"{len(run.fits):,}", "fits")]
    if len(run.fits) and "status" in run.fits.colnames:
        good = np.mean([str(s) == "converged" for s in run.fits["status"]])
        numbers.append((f"{100 * good:.1f} %", "of the fits converged"))
    numbers.append((f"{int((state == FLAGGED).sum()):,}", "sources flagged"))
    numbers.append((f"{int((state == FAILED).sum()):,}", "sources failed"))
    if area_arcmin2:
        numbers.append((f"{area_arcmin2:.3g}", "square arcminutes"))
    inner = "".join(f"<div><dt>{escape(b)}</dt><dd>{escape(a)}</dd></div>" for a, b in numbers)
    name = "/".join(run.folder.absolute().parts[-2:])
    return (
        f'<header class="top"><p class="kicker">clresample field report</p><h1>{escape(name)}</h1>'
        f'<p class="about">{escape(what)}</p><dl class="numbers">{inner}</dl></header>'
    )


def notices(run, notes) -> str:
    """Notices at the top: an unfinished run, failed tiles, files that are missing."""
    lines = []
    if not run.finished:
        done = dict(run.done)
        if "blends fitted" in done:
            done["blends fitted"] = len(run.fits), done["blends fitted"][1]
        told = [f"{a} of {b} {what}" if b else f"{a} {what}" for what, (a, b) in done.items()]
        lines.append(
            f"This run has not finished: {', '.join(told)}. What follows is of the fits that are "
            "done; clresample field --resume goes on."
        )
    part = run.settings.get("part")
    if isinstance(part, list) and len(part) >= 2:
        lines.append(f"Part {part[0]} of {part[1]} of its field.")
    lost = run.provenance.get("failed_tiles") or {}
    lines += [f"Tile {tile} is lost: {reason}" for tile, reason in dict(lost).items()]
    lines += [str(note) for note in notes]
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<div class="notes" role="note"><ul>{items}</ul></div>'


def source_table(run) -> str:
    """The sources of the highest signal to noise, to be read without a script."""
    rows = run.sources
    if not len(rows):
        return section("sources", "Sources", text("No source was found or fitted."))
    columns = columns_of(run)
    order = order_of(run)[:MAX_ROWS].tolist()
    body = [
        [
            str(int(rows["id"][k])),
            *(format_number(one.values[k], one.form) for one in columns),
            flag_names(np.nan_to_num(rows["flags"][k])) if "flags" in rows.colnames else "",
            str(rows["status"][k]) if "status" in rows.colnames else "",
        ]
        for k in order
    ]
    heads = [("id", "", "n"), *((one.title, one.unit, "n") for one in columns)]
    heads += [("flags", "", ""), ("fit", "", "")]
    told = f"{len(body)} of {len(rows)} sources, the highest signal to noise first"
    return section("sources", "Sources", FILTERS, table(told, heads, body, link=0))


def colours(run) -> str:
    """The colour-magnitude diagram, which a script draws; nothing without two magnitudes."""
    if sum(one.kind == "magnitude" for one in columns_of(run)) < 2:
        return ""
    return (PAGE / "colours.html").read_text()


def photometry(run, truth, area_arcmin2) -> str:
    """Number counts, and flux against signal to noise."""
    counts, ratio = number_counts(run, truth, area_arcmin2), signal_to_noise(run)
    if not counts and not ratio:
        return ""
    key = '<p class="legend"><span><span class="key bars"></span>catalogue</span>'
    if truth is not None:
        key += '<span><span class="key outline"></span>truth</span>'
    told = "The dotted line is a flux of five times its error."
    return section(
        "counts", "Number counts", charts([(*one, "") for one in counts]), f"{key}</p>"
    ) + section(
        "noise", "Flux against signal to noise", text(told), charts([(*o, "") for o in ratio])
    )


def chi2(run, pyramids) -> str:
    """Sources whose model does not agree with the data."""
    if not pyramids:
        return ""
    told = (
        "Mean of (residual / σ)² in cells, all channels of an instrument together; σ is the "
        "scatter of the channel's residuals over the whole mosaic, so that 1 is noise alone where "
        "the noise is the same everywhere. Dead columns and pixels without data are left out."
    )
    figures = [(*one, "") for one in chi2_maps(pyramids)]
    ramp = (
        f'<p class="legend"><span>χ² {CHI2_ENDS[0]:g}<svg class="ramp" viewBox="0 0 31 1" '
        'preserveAspectRatio="none" role="img" aria-label="colours of chi2">'
        f"{_ramp(chi2_palette())}</svg>{CHI2_ENDS[1]:g}, logarithmic, 1 in the middle</span></p>"
    )
    return section("chi2", "χ² over the field", text(told), charts(figures), ramp, _misfits(run))


def _ramp(palette):
    return "".join(
        f'<rect x="{i}" width="1" height="1" fill="rgb({r},{g},{b})"/>'
        for i, (r, g, b) in enumerate(palette[1:].tolist())
    )


def _misfits(run):
    """The sources with the largest residuals."""
    names = [n for n in run.sources.colnames if n.startswith("max_residual_")]
    if not names or not len(run.sources):
        return ""
    values = np.nan_to_num(np.stack([plain(run.sources[n]) for n in names], axis=1))
    order = np.argsort(-values.max(axis=1), kind="stable")[:SLOWEST]
    rows = [
        [
            str(int(run.sources["id"][k])),
            names[int(values[k].argmax())].removeprefix("max_residual_"),
            format_number(values[k].max(), ".1f"),
            flag_names(np.nan_to_num(run.sources["flags"][k])),
        ]
        for k in order
    ]
    heads = [("id", "", "n"), ("channel", "", ""), ("residual", "σ", "n"), ("flags", "", "")]
    return "<h3>Largest residuals</h3>" + table(
        f"The {len(rows)} sources with the largest residuals", heads, rows, sort=True, link=0
    )


def truth_section(run, truth) -> str:
    """Pulls, and which true sources were found."""
    if truth is None:
        return ""
    n = int((truth.matched_rows[truth.is_interior] >= 0).sum())
    told = (
        f"{n} of the {truth.is_interior.sum()} true sources over {EDGE_PX:g} pixels from the edge "
        f"have a "
        f"row within {FOUND_PX:g} pixels. Pulls of correct errors scatter like the dashed normal "
        "distribution, median 0 and width 1. The outermost bins hold all that is farther out."
    )
    figures = [
        (
            channel,
            svg,
            f"median {format_number(m, '.2f')}, width {format_number(w, '.2f')}, n = {k}",
        )
        for channel, svg, m, w, k in pull_charts(run, truth)
    ]
    parts = [text(told), charts(figures)]
    found = completeness(truth)
    if found is not None:
        rows = [
            [format_number(a, ".4g"), format_number(b, ".4g"), k, m] for a, b, k, m in found[1] if m
        ]
        heads = [("S/N from", "", "n"), ("to", "", "n"), ("found", "", "n"), ("of", "", "n")]
        told = f"True sources over {EDGE_PX:g} px from the field's edge"
        shares = charts([("Completeness", found[0], "")], table(told, heads, rows))
        parts.append(shares)
    return section("truth", "Against the truth", *parts)


def fits(run) -> str:
    """Outcomes of the fits, the slowest and the failed ones."""
    if not len(run.fits):
        return section("fits", "Fits", text("Nothing is known of single fits."))
    rows = run.fits
    ended = Counter(str(s).split(":")[0] for s in rows["status"])
    told = ", ".join(f"{n:,} {how}" for how, n in ended.most_common())
    heads = [
        ("blend", "", "n"), ("sources", "", "n"), ("pixels", "", "n"), ("iterations", "", "n"),
        ("time", "s", "n"), ("round", "", "n"), ("how it ended", "", "long"),
    ]  # fmt: skip

    def row(k):
        whole = [
            str(int(rows[n][k])) for n in ("parent_id", "n_sources", "n_pixels", "n_iterations")
        ]
        seconds = format_number(plain(rows["seconds"][k : k + 1])[0], ".2f")
        return [*whole, seconds, str(int(rows["n_refits"][k])), str(rows["status"][k])]

    slow = np.argsort(-plain(rows["seconds"]), kind="stable")[:SLOWEST]
    bad = [k for k, s in enumerate(rows["status"]) if str(s).startswith("failed")]
    parts = [text(told + "."), charts([("Time of fits", fit_times(run), "")])]
    parts.append("<h3>Slowest</h3>")
    caption = f"The {len(slow)} slowest of {len(rows)} fits"
    parts.append(table(caption, heads, [row(k) for k in slow], sort=True, link=0))
    parts.append("<h3>Failed</h3>")
    if bad:
        shown = [row(k) for k in bad[:MAX_FAILED]]
        caption = f"{len(shown)} of {len(bad)} fits that failed, with the reason"
        parts.append(table(caption, heads, shown, sort=True, link=0))
    else:
        parts.append(text("None."))
    return section("fits", "Fits", *parts)


def origin(run) -> str:
    """Provenance of the field: versions, device, times, settings, inputs with their checksums."""
    found = run.provenance
    pairs = [("clresample", found.get("clresample", "")), ("Python", found.get("python", ""))]
    pairs += [(name, v or "not installed") for name, v in dict(found.get("packages") or {}).items()]
    pairs += [("device", found.get("device", "")), ("written", found.get("written", ""))]
    for stage, seconds in dict(found.get("seconds") or {}).items():
        pairs.append((f"time, {stage}", f"{seconds:.1f} s" if _is_number(seconds) else seconds))
    for key, value in run.settings.items():
        if key != "inputs":
            pairs.append((key, value if isinstance(value, str) else json.dumps(value)))
    pairs = [(what, value) for what, value in pairs if value not in ("", None)]
    inputs = [
        [what, one.get("file", ""), one.get("sha256") or "–"]
        for what, one in dict(found.get("inputs") or {}).items()
        if isinstance(one, dict)
    ]
    heads = [("input", "", ""), ("file", "", ""), ("SHA-256", "", "long")]
    return section(
        "origin", "Origin", definition_table(pairs), table("Files that were read", heads, inputs)
    )


def _is_number(value):
    return isinstance(value, int | float)
