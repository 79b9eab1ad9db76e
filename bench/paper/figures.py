"""Figures of the report: maps of numbers, images with their residuals, times against sizes."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from clresample.drawing.figure import RESIDUAL_COLOURS, SKY_COLOURS, import_figure, stretch
from clresample.files.atomic import atomic_file
from clresample.files.panels import stretch_limits

DPI = 110  # dots per inch: a page's width in about 100 kB
INK, FAINT, BLANK = "#20242c", "#c9ced8", "#f1f3f6"
NAMES = {
    "ours": "ours",
    "ours64": "ours, float64",
    "paper": "the paper's scheme",
    "quintic": "GalSim quintic",
    "sinc": "GalSim sinc",
}
COLOURS = {"ours": "#1769aa", "paper": "#e07b1a", "quintic": "#3a9158", "sinc": "#8a5fb0"}
# of the worst cases; `accuracy` has as many
CASE_COLOURS = ("#1769aa", "#c23b4e", "#20242c")
MARKERS = {"ours": "o", "paper": "s", "quintic": "^", "sinc": "v"}


@dataclass(frozen=True, eq=False)
class Map:
    """Numbers by row and column, drawn as colours with the numbers on them.

    values (n, m): NaN is left blank, infinity is called exact
    form: format of a number
    limits (2,): values of the first and last colour; None: those of the numbers
    diverging: blue below and red above 0, white at it
    """

    title: str
    values: np.ndarray
    form: str = ".1f"
    limits: tuple | None = None
    diverging: bool = False


def heat_maps(path, maps, *, rows, columns, row_label, column_label):
    """Draws maps side by side.

    maps: list of `Map`; rows, columns: their names, the same for all; row_label, column_label:
        what they are
    """
    n_y, n_x = len(rows), len(columns)
    figure, axes = _figure(1, len(maps), 0.62 * n_x + 1.1, 0.62 * n_y + 0.9)
    for ax, item in zip(axes[0], maps):
        finite = item.values[np.isfinite(item.values)]
        low, high = item.limits or (finite.min(), finite.max())
        if item.diverging:
            high = max(abs(low), abs(high))
            low = -high
        colours = RESIDUAL_COLOURS if item.diverging else "viridis"
        values = np.ma.masked_invalid(np.where(np.isposinf(item.values), high, item.values))
        ax.imshow(values, cmap=colours, vmin=low, vmax=high)
        ax.set_facecolor(BLANK)
        for (i, j), value in np.ndenumerate(item.values):
            if np.isnan(value):
                continue
            share = (min(value, high) - low) / ((high - low) or 1)
            light = 0.2 < share < 0.8 if item.diverging else share > 0.55
            text = "exact" if np.isinf(value) else format(value, item.form)
            ax.text(j, i, text, ha="center", va="center", size=9, color=INK if light else "white")
        ax.set_title(item.title, size=10.5)
        ax.set_xticks(range(n_x), columns, size=8)
        ax.set_yticks(range(n_y), rows, size=8)
        ax.set_xlabel(column_label)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    axes[0, 0].set_ylabel(row_label)
    save(path, figure)


@dataclass(frozen=True, eq=False)
class Images:
    """One resampling: model and truth as drawn, both estimates of the truth and their SDRs."""

    title: str
    model: np.ndarray
    truth: np.ndarray
    ours: np.ndarray
    galsim: np.ndarray
    sdr: tuple


def resampled(path, cases):
    """Draws truths, estimates and residuals as in the paper, two columns for each of `Images`."""
    size = 3.3 * len(cases), 5.3  # inches
    figure = import_figure()(figsize=size, dpi=DPI, layout="constrained")
    for case, part in zip(cases, figure.subfigures(1, len(cases), squeeze=False, wspace=0.02)[0]):
        part.suptitle(case.title, size=11)
        axes = part.subplots(3, 2)
        limits = stretch_limits(case.truth)
        _sky(axes[0, 0], case.model, stretch_limits(case.model), "model")
        _sky(axes[0, 1], case.truth, limits, "truth")
        residuals = case.ours - case.truth, case.galsim - case.truth
        width = max(np.abs(residual).max() for residual in residuals)
        names = f"ours: {case.sdr[0]:.1f} dB", f"GalSim: {case.sdr[1]:.1f} dB"
        for i, (image, residual) in enumerate(zip((case.ours, case.galsim), residuals)):
            _sky(axes[1, i], image, limits, names[i])
            colours = {"cmap": RESIDUAL_COLOURS, "vmin": -width, "vmax": width}
            axes[2, i].imshow(residual, origin="lower", **colours)
            percent = 100 * np.abs(residual).max() / case.truth.max()
            axes[2, i].set_title(f"residual ≤ {percent:.1g} % of peak", size=8, pad=3)
        for ax in axes.flat:
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_color(FAINT)
    save(path, figure)


def _sky(ax, image, limits, title):
    ax.imshow(stretch(image, limits), cmap=SKY_COLOURS, vmin=0, vmax=1, origin="lower")
    ax.set_title(title, size=8, pad=3)


def edges(path, margin, edge, worst):
    """Draws what light at the stamp's edge does, and what padding does to the worst cases.

    margin [dB], edge: ours above GalSim's default, and relative light in the edge, per stamp
    worst: rows of `accuracy.padded`
    """
    figure, axes = _figure(1, 2, 4.6, 3.6)
    left, right = axes[0]
    wins = margin < 0
    left.scatter(edge[~wins], margin[~wins], s=4, color=COLOURS["ours"], alpha=0.25, lw=0)
    left.scatter(edge[wins], margin[wins], s=9, color=COLOURS["quintic"], lw=0)
    left.axhline(0, color=INK, lw=0.8)
    left.set_xscale("log")
    left.set_xlabel("light in the model stamp's outermost pixels, relative norm")
    left.set_ylabel("SDR, ours minus GalSim quintic [dB]")
    left.set_title(f"{wins.sum()} of {wins.size} stamps better by GalSim quintic (green)", size=10)
    for case, colour, marker in zip(worst, CASE_COLOURS, "osD"):
        sizes = [row["n_model"] / case["padded"][0]["n_model"] for row in case["padded"]]
        label = f"{case['from']} → {case['to']}, galaxy {case['galaxy']}"
        for name, style, text in (("ours", "-", label), ("quintic", "--", None)):
            values = [row[name] for row in case["padded"]]
            right.plot(sizes, values, style, marker=marker, ms=4, color=colour, label=text)
        right.plot(sizes[0], case["wide"]["ours"], "*", ms=11, color=colour)
    right.plot([], [], "*", ms=9, color=INK, label="ours, stamp cut from a wide drawing")
    right.plot([], [], "--", color=INK, label="GalSim quintic")
    right.set_xlabel("model stamp's side, over the observed stamp's")
    right.set_ylabel("SDR [dB]")
    right.set_title("padding the three worst", size=10)
    right.legend(frameon=False, fontsize=7)
    save(path, figure)


def time_ratios(path, rows, fits, paper):
    """Draws times over GalSim's default against M: the paper's scheme and ours, and fitted lines.

    rows: of `timing`, one pair and size each; fits: scheme -> (intercept, slope); paper: likewise
    """
    figure, axes = _figure(1, 2, 4.8, 3.7)
    m = np.array([row["n_obs"] for row in rows])
    line = np.array([0, m.max()])
    for ax, name in zip(axes[0], ("paper", "ours")):
        ratio = [row["ms"][name] / row["ms"]["quintic"] for row in rows]
        points = ax.scatter(m, ratio, c=[row["n_model"] for row in rows], s=16, cmap="viridis")
        a, b = fits[name]
        ax.plot(line, a + b * line, color=COLOURS["paper"], label=f"fit: {line_text(a, b)}")
        ax.set_title(f"{NAMES[name]} / GalSim quintic", size=10)
        ax.set_xlabel("M, observed pixels a side")
        ax.set_ylim(0, 1.12 * max(ratio))
    axes[0, 0].plot(
        line,
        paper[0] + paper[1] * line,
        "--",
        color=INK,
        lw=1,
        label=f"the paper's fit: {line_text(*paper)}",
    )
    axes[0, 0].set_ylabel("ratio of times")
    for ax in axes[0]:
        ax.legend(frameon=False, fontsize=8)
    figure.colorbar(points, ax=list(axes[0]), label="N, model pixels a side", pad=0.01)
    save(path, figure)


def absolute_timings(path, sizes, means, setups):
    """Draws mean times [ms] of each method and its set-up against N: name -> values by size."""
    figure, axes = _figure(1, 2, 4.6, 3.7)
    for ax, times, title in zip(
        axes[0], (means, setups), ("one image, mean over survey pairs", "set-up, once")
    ):
        for name, values in times.items():
            _curve(ax, sizes, values, name, NAMES[name])
        ax.set_title(title, size=10)
    axes[0, 0].set_ylabel("time [ms]")
    axes[0, 0].legend(frameon=False, fontsize=8)
    save(path, figure)


def schemes(path, rows):
    """Draws both schemes' times [ms] and their ratio against N; rows: as `timing` writes them."""
    figure, axes = _figure(1, 2, 4.6, 3.7)
    left, right = axes[0]
    for row, style in zip(rows, ("-", "--")):
        angle, sizes, ours, paper = (
            row[name] for name in ("angle_deg", "n_model", "ours", "paper")
        )
        _curve(left, sizes, ours, "ours", f"ours, {angle:g}°", style)
        _curve(left, sizes, paper, "paper", f"the paper's, {angle:g}°", style)
        ratio = np.divide(paper, ours)
        right.plot(sizes, ratio, style, marker="o", ms=4, color=INK, label=f"{angle:g}°")
        place = {"xytext": (-3, 4), "ha": "right"} if style == "-" else {"xytext": (4, -9)}
        for x, y in zip(sizes, ratio):
            right.annotate(f"{y:.1f}", (x, y), textcoords="offset points", size=7, **place)
    left.set_ylabel("time [ms]")
    left.set_title("both schemes, in one run", size=10)
    right.set(xscale="log", yscale="log")
    _size_ticks(right, sizes)
    right.margins(0.12)
    right.set_title("time of the paper's scheme over ours", size=10)
    for ax in (left, right):
        ax.legend(frameon=False, fontsize=8)
    save(path, figure)


def _curve(ax, x, y, name, label, style="-"):
    ax.loglog(x, y, style, marker=MARKERS[name], ms=4, color=COLOURS[name], label=label)
    ax.grid(color=BLANK)
    _size_ticks(ax, x)


def _size_ticks(ax, sizes):
    ax.set_xticks(sizes, sizes)
    ax.set_xticks([], minor=True)
    ax.set_xlabel("N, model pixels a side")


def line_text(intercept, slope):
    """A straight line in M as text."""
    return f"{intercept:.2g} {'-' if slope < 0 else '+'} {abs(slope):.2g} M"


def _figure(n_y, n_x, width, height):
    """A figure of n_y x n_x axes, each of this size [inches]."""
    figure = import_figure()(figsize=(n_x * width, n_y * height), dpi=DPI, layout="constrained")
    return figure, figure.subplots(n_y, n_x, squeeze=False)


def save(path, figure):
    """Writes a PNG of 256 colours, white among them, whole or not at all. Raises FileError."""
    from PIL import Image  # comes with matplotlib

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", facecolor="white")
    few = Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    with atomic_file(path) as part:
        few.save(part, format="png", optimize=True)
