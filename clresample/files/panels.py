"""Pieces that the figures share: colours, stretches, labelled panels, PNG files."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..sky.grid import Grid

PANEL_INCHES, DPI = 2.75, 160  # a row of four fills a page's width
INK, PAPER, FRAME = "#e8eaf0", "#10131a", "#3a4152"
SKY_COLOURS, RESIDUAL_COLOURS = "inferno", "RdBu_r"
BAR_FRACTION = 0.3  # of a panel's width that the scale bar stays below
# Of the brightest pixels, so that one hot pixel does not darken the rest.
BRIGHT_QUANTILE = 0.9995
RESIDUAL_SIGMAS = 10  # a residual's colours end at so many deviations of its background
MAD = 1.4826  # standard deviation of Gaussian noise over its median absolute deviation


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of a row.

    image (Ny, Nx): pixels on `grid`; NaN is left blank
    title, note: above, and below in smaller type
    limits: (black, knee, white) of an asinh stretch, as `stretch_limits` gives them; None = its own
    residual: show on a linear scale between -residual and +residual
    """

    image: np.ndarray
    grid: Grid
    title: str
    note: str = ""
    limits: tuple | None = None
    residual: float | None = None


def noise_level(image):
    """Median and standard deviation of the background, by the median absolute deviation."""
    pixels = image[np.isfinite(image)]
    median = float(np.median(pixels))
    return median, MAD * float(np.median(np.abs(pixels - median)))


def stretch_limits(image):
    """(black, knee, white) of an asinh stretch: linear in the noise, logarithmic in the light."""
    median, sigma = noise_level(image)
    white = float(np.nanquantile(image, BRIGHT_QUANTILE))
    # without noise, or where most is empty: three decades of light, of the level if all is flat
    knee = max(3 * sigma, (white - median) / 1000) or max(abs(median), 1) / 1000
    return median - knee, knee, max(white, median + knee)


def stretch(image, limits):
    """Brightness 0 ... 1:  asinh((I - black) / knee) / asinh((white - black) / knee)."""
    black, knee, white = limits
    return np.clip(np.arcsinh((image - black) / knee) / np.arcsinh((white - black) / knee), 0, 1)


def import_figure():
    """matplotlib's Figure. Raises ImportError that says what to install."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(
            "pictures need matplotlib, which is not installed: pip install 'clresample[plot]'"
        ) from error
    return Figure


def save_panels(path, panels, *, like: Grid, title=""):
    """Write a row of panels as a PNG, each in the place and orientation that it has on `like`.

    path: the file, written whole or not at all; panels: list of Panel
    like: the pixels that fill every panel's frame; title: above the row
    """
    n_y, n_x = like.shape
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    above, below = (0.64 if title else 0.36), 0.36  # inches for the text
    gap = 0.08
    size = len(panels) * (width + gap) + gap, height + above + below
    figure = import_figure()(figsize=size, dpi=DPI, facecolor=PAPER)
    if title:
        figure.text(
            gap / size[0],
            1 - 0.1 / size[1],
            title,
            color=INK,
            fontsize=11,
            weight="bold",
            va="top",
            ha="left",
        )
    for i, panel in enumerate(panels):
        left = gap + i * (width + gap)
        box = left / size[0], below / size[1], width / size[0], height / size[1]
        axes = figure.add_axes(box, facecolor=PAPER)
        show_image(axes, panel, like)
        axes.set_title(panel.title, color=INK, fontsize=10, pad=5)
        axes.set_xlabel(panel.note, color=INK, fontsize=8, labelpad=5)
        if i == 0:
            scale_bar(axes, like)
    write_png(Path(path), figure)


def write_png(path, figure):
    """A PNG of these 256 colours, under another name first: the file is whole or absent."""
    import matplotlib
    from PIL import Image  # comes with matplotlib

    maps = (SKY_COLOURS, 120), (RESIDUAL_COLOURS, 100)
    colours = [matplotlib.colormaps[name](np.linspace(0, 1, n))[:, :3] for name, n in maps]
    ends = [np.array(list(bytes.fromhex(colour[1:]))) / 255 for colour in (PAPER, INK)]
    colours.append(ends[0] + np.linspace(0, 1, 34)[:, None] * (ends[1] - ends[0]))
    colours.append([[1, 1, 1], [int(FRAME[i : i + 2], 16) / 255 for i in (1, 3, 5)]])
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.rint(255 * np.concatenate(colours)).astype(np.uint8).tobytes())
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", facecolor=PAPER)
    part = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        few = Image.open(drawn).convert("RGB").quantize(palette=palette, dither=0)
        few.save(part, format="png", optimize=True)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def show_image(axes, panel, like):
    from matplotlib.transforms import Affine2D

    mapping = panel.grid.map_to(like)
    (a, b), (c, d) = mapping.matrix  # rows (y, x), columns (n, m)
    t_y, t_x = mapping.offset
    place = Affine2D.from_values(d, b, c, a, t_x, t_y)
    n_y, n_x = panel.grid.shape
    if panel.residual is None:
        limits = panel.limits or stretch_limits(panel.image)
        image, colours, low, high = stretch(panel.image, limits), SKY_COLOURS, 0, 1
    else:
        image, colours, low, high = panel.image, RESIDUAL_COLOURS, -panel.residual, panel.residual
    axes.imshow(
        image,
        cmap=colours,
        vmin=low,
        vmax=high,
        origin="lower",
        interpolation="nearest",
        extent=(-0.5, n_x - 0.5, -0.5, n_y - 0.5),
        transform=place + axes.transData,
    )
    axes.set(
        xlim=(-0.5, like.shape[1] - 0.5), ylim=(-0.5, like.shape[0] - 0.5), xticks=[], yticks=[]
    )
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def scale_bar(axes, like):
    """A bar of a round number of arcsec in the lower left corner."""
    scale = like.pixel_scale_arcsec
    longest = BAR_FRACTION * like.shape[1] * scale
    power = 10 ** np.floor(np.log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    x0, y0 = 0.05 * np.array(like.shape[::-1]) - 0.5
    axes.plot([x0, x0 + length / scale], [y0, y0], color="white", lw=1.6, solid_capstyle="butt")
    text = f"{length / 60:g}′" if length >= 60 else f"{length:g}″"
    axes.text(
        x0 + length / scale / 2,
        y0 + 0.015 * like.shape[0],
        text,
        color="white",
        fontsize=8,
        ha="center",
        va="bottom",
    )
