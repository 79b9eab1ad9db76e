"""Draws a deblended scene: observed images, model and residual of each instrument."""

from __future__ import annotations

import numpy as np

from .figure import GAP, INK, PAPER, add_panel, dark_figure, show_image

PANEL_INCHES = 3.2
ABOVE, BELOW = 0.62, 0.28  # [inch] for the titles, and for the line below each row
KNEE_SIGMAS = 2.0  # [sigma] where the asinh stretch turns from linear to logarithmic
BRIGHT_QUANTILE = 0.999  # of the model's pixels: shown as white
RESIDUAL_SIGMAS = 6.0  # at which a residual's colours end
FEW = 40  # up to this many sources are numbered; with more, only positions are marked
MARK = "#7fe3ff"
COLUMNS = "observed", "model", "residual"


def deblended_figure(result, *, title=""):
    """Observed, model and residual of every observation, with the sources marked, as a figure.

    Observations of three or more channels are shown in colour: the three neighbouring channels of
    the highest signal to noise as blue, green and red. Residuals are in units of the noise.

    result: a fitted blend; title: above the rows
    returns matplotlib Figure

    Raises ImportError, with what to install, without matplotlib.
    """
    n_y, n_x = result.frame.shape
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    n_rows = len(result.observations)
    figure = dark_figure(3 * (width + GAP) + GAP, ABOVE + n_rows * (height + BELOW), title)
    for i, o in enumerate(result.observations):
        mapping = result.footprints[i].mapping
        chosen = _shown(result, i)
        names = [o.channels[c] for c in chosen]
        how = f"{', '.join(names)} as blue, green, red" if len(names) == 3 else names[0]
        chi2 = o.chi2_map(o.data - result.model(i))[result.footprints[i].used]
        mean = chi2.mean() if chi2.size else np.nan
        notes = how, "", f"±{RESIDUAL_SIGMAS:g} sigma; chi2 per pixel {mean:.2f}"
        top = ABOVE + i * (height + BELOW)
        for k, (image, note) in enumerate(zip(_pictures(result, i, chosen), notes, strict=True)):
            axes = add_panel(figure, GAP + k * (width + GAP), top, width, height)
            show_image(axes, image, mapping, residual=k == 2)
            _mark(axes, result, numbers=k == 1)
            if i == 0:
                axes.set_title(COLUMNS[k], color=INK, fontsize=10, pad=5)
            if k == 0:
                axes.set_ylabel(o.name or f"observation {i}", color=INK, fontsize=9, labelpad=-12)
                axes.yaxis.label.set_bbox({"facecolor": PAPER, "edgecolor": "none", "pad": 1.5})
            axes.set_xlabel(note, color=INK, fontsize=8, labelpad=3)
    return figure


def _shown(result, i_observation):
    """Channels to show: three neighbours if there are three or more, else the best one."""
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


def _mark(axes, result, *, numbers):
    """Crosses at the sources; as many as can be read are named."""
    from matplotlib.patheffects import withStroke

    positions = result.frame.positions_of(result.sources)
    inside = result.frame.contains(positions)
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
