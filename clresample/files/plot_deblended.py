"""The picture of a deblended scene: what each instrument saw, the model, and what is left."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np

from ..measurement.quality import labels, summary
from .panels import DPI, FRAME, INK, PAPER, RESIDUAL_COLOURS, SKY_COLOURS, import_figure

PANEL_INCHES = 3.2
ABOVE, BELOW, GAP = 0.62, 0.28, 0.06  # inches for the title, each row's line, and between panels
KNEE_SIGMAS = 2.0  # where the asinh stretch turns from linear to logarithmic
BRIGHT_QUANTILE = 0.999  # of the model's pixels: shown as white
RESIDUAL_SIGMAS = 6.0  # a residual's colours end here
FEW = 40  # as many sources are numbered; of more only the places are marked
MARK = "#7fe3ff"
N_COLOURS = 256  # of the file, chosen to cover all hues: a quarter of the size of a file of all


def plot_deblended(path, result, *, title=""):
    """Draw observed, model and residual of every observation, with the sources marked, as a PNG.

    Observations of three or more channels are shown in colour: the three neighbouring channels of
    the highest signal to noise as blue, green and red. Residuals are in units of the noise.

    path: the file, written whole or not at all; result: a fitted blend; title: above the rows
    Raises ImportError, with what to install, without matplotlib.
    """
    figure_class = import_figure()
    n_y, n_x = result.frame.shape
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    n_rows = len(result.observations)
    size = 3 * (width + GAP) + GAP, ABOVE + n_rows * (height + BELOW)
    figure = figure_class(figsize=size, dpi=DPI, facecolor=PAPER)
    figure.text(
        GAP / size[0], 1 - 0.09 / size[1], title, color=INK, fontsize=11, weight="bold", va="top"
    )
    chi2 = summary(result)["chi2"]
    for i, (label, o) in enumerate(zip(labels(result), result.observations, strict=True)):
        chosen = _shown(result, i)
        panels = _pictures(result, i, chosen)
        names = [o.channels[c] for c in chosen]
        how = f"{', '.join(names)} as blue, green, red" if len(names) == 3 else names[0]
        mean = np.nanmean([chi2[channel] for channel in o.channels])
        notes = how, "", f"±{RESIDUAL_SIGMAS:g} sigma; chi2 per pixel {mean:.2f}"
        top = ABOVE + i * (height + BELOW)
        for k, (image, note) in enumerate(zip(panels, notes, strict=True)):
            left = GAP + k * (width + GAP)
            box = (left / size[0], 1 - (top + height) / size[1], width / size[0], height / size[1])
            axes = figure.add_axes(box, facecolor=PAPER)
            _show(axes, image, o.grid, result.frame.grid, residual=k == 2)
            _mark(axes, result, numbers=k == 1)
            if i == 0:
                axes.set_title(("observed", "model", "residual")[k], color=INK, fontsize=10, pad=5)
            if k == 0:
                axes.set_ylabel(label, color=INK, fontsize=9, labelpad=-12)
                axes.yaxis.label.set_bbox({"facecolor": PAPER, "edgecolor": "none", "pad": 1.5})
            axes.set_xlabel(note, color=INK, fontsize=8, labelpad=3)
    _write_png(Path(path), figure)


def _shown(result, i_observation):
    """Channels to show: three neighbours where there are so many, else the best one."""
    o = result.observations[i_observation]
    signal = np.sqrt((o.weights * result.model(i_observation) ** 2).sum(axis=(1, 2)))
    if len(signal) < 3:
        return [int(np.argmax(signal))]
    first = int(np.argmax(np.convolve(signal, np.ones(3), "valid")))
    return [first, first + 1, first + 2]


def _pictures(result, i_observation, chosen):
    """Observed, model (My, Mx) or (My, Mx, 3) in 0 ... 1, and residual in -1 ... 1 of the colours.

    Channels are balanced so that the whole model is white. Colours survive the stretch:
    I -> asinh(I / knee) / asinh(white / knee) multiplies all three channels by one factor.
    """
    o = result.observations[i_observation]
    sky = result.sky[result.channel_slices()[i_observation]][chosen, None, None]
    data, model = o.data[chosen] - sky, result.model(i_observation)[chosen] - sky
    weights = o.weights[chosen]
    residual = result.residual(i_observation)[chosen] * np.sqrt(weights) / RESIDUAL_SIGMAS
    light = np.maximum(model, 0).sum(axis=(1, 2))
    balance = np.where(light > 0, light.mean() / np.where(light > 0, light, 1), 1)
    seen = weights > 0
    sigma = [
        np.median(w[s]) ** -0.5 if s.any() else 1.0 for w, s in zip(weights, seen, strict=True)
    ]
    knee = KNEE_SIGMAS * float(np.sqrt(np.mean((balance * sigma) ** 2) / len(chosen)))
    shown = [np.where(seen, image, np.nan) * balance[:, None, None] for image in (data, model)]
    total = [image.mean(axis=0) for image in shown]
    white = max(float(np.nanquantile(total[1], BRIGHT_QUANTILE)), 3 * knee)
    out = []
    for image, light in zip(shown, total, strict=True):
        level = np.arcsinh((light + knee / 2) / knee) / np.arcsinh(white / knee)
        if len(chosen) == 1:
            out.append(np.clip(level, 0, 1))
            continue
        factor = np.maximum(level, 0) / np.maximum(light + knee / 2, knee / 2)
        colour = (image + knee / 2) * factor
        colour = colour / np.maximum(1, colour.max(axis=0))  # too bright: keep the hue
        out.append(np.moveaxis(np.clip(np.nan_to_num(colour), 0, 1), 0, -1)[..., ::-1])
    if len(chosen) == 1:
        return *out, residual[0]
    grey = 0.5 + 0.5 * np.clip(np.nan_to_num(residual), -1, 1)
    return *out, np.moveaxis(grey, 0, -1)[..., ::-1]


def _show(axes, image, grid, like, *, residual):
    """An image in the place and orientation that it has on `like`."""
    from matplotlib.transforms import Affine2D

    mapping = grid.map_to(like)
    (a, b), (c, d) = mapping.matrix  # rows (y, x), columns (n, m)
    t_y, t_x = mapping.offset
    n_y, n_x = grid.shape
    axes.imshow(
        image,
        cmap=RESIDUAL_COLOURS if residual else SKY_COLOURS,
        vmin=-1 if residual else 0,
        vmax=1,
        origin="lower",
        interpolation="nearest",
        extent=(-0.5, n_x - 0.5, -0.5, n_y - 0.5),
        transform=Affine2D.from_values(d, b, c, a, t_x, t_y) + axes.transData,
    )
    axes.set(
        xlim=(-0.5, like.shape[1] - 0.5), ylim=(-0.5, like.shape[0] - 0.5), xticks=[], yticks=[]
    )
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def _mark(axes, result, *, numbers):
    """Crosses at the sources; as many as can be read are named."""
    from matplotlib.patheffects import withStroke

    positions = result.frame.place(result.sources)
    inside = result.frame.inside(positions)
    few = inside.sum() <= FEW
    for i in np.flatnonzero(inside):
        y, x = positions[i]
        axes.plot(x, y, "+", color=MARK, ms=5, mew=0.7)
        if numbers and few:
            axes.annotate(
                result.sources[i].name or str(i),
                (x, y),
                (3, 3),
                textcoords="offset points",
                color=MARK,
                fontsize=7,
                path_effects=[withStroke(linewidth=1.2, foreground="black")],
            )


def _write_png(path, figure):
    """A PNG of few colours, under another name first: the file is whole or absent."""
    from PIL import Image  # comes with matplotlib

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", facecolor=PAPER)
    part = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        few = Image.open(drawn).convert("RGB")
        few = few.quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=4, dither=0)
        few.save(part, format="png", optimize=True)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
