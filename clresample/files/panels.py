"""Pictures of images side by side, and small PNG files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..drawing.figure import (
    GAP,
    INK,
    add_panel,
    dark_figure,
    limits_of,
    scale_bar,
    show_image,
    stretch,
)
from ..sky.grid import Grid
from ..sky.noise import background
from .atomic import atomic_file

PANEL_INCHES = 2.75  # a row of four panels fills a page's width
# of the pixels: shown as white, so that one hot pixel does not darken the others
BRIGHT_QUANTILE = 0.9995
RESIDUAL_SIGMAS = 10  # [sigma of its background] at which a residual's colours end
# Number of colours of a PNG: the file has a third of the size of a full-colour file, with an rms
# difference of 3 of 256. Colours are chosen from every fourth pixel of every fourth row, 7 times
# faster than from all pixels and as accurate; sparser samples lose the colour of thin lines.
N_COLOURS, SAMPLE_STEP = 256, 4
KMEANS_ROUNDS = 4  # iterations of k-means


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


def stretch_limits(image):
    """(black, knee, white) of an asinh stretch: linear in the noise, logarithmic in the light."""
    return limits_of(*background(image), float(np.nanquantile(image, BRIGHT_QUANTILE)))


def save_panels(path, panels, *, like: Grid, title=""):
    """Writes a row of panels as a PNG, each with its position and orientation on `like`.

    path: the file, written whole or not at all; panels: list of Panel
    like: the pixels that fill every panel's frame; title: above the row

    Raises ImportError, with what to install, without matplotlib; FileError where the file cannot be
    written.
    """
    n_y, n_x = like.shape
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    above, below = (0.64 if title else 0.36), 0.36  # inches for the text
    figure = dark_figure(len(panels) * (width + GAP) + GAP, height + above + below, title)
    for i, panel in enumerate(panels):
        axes = add_panel(figure, GAP + i * (width + GAP), above, width, height)
        if panel.residual is None:
            image = stretch(panel.image, panel.limits or stretch_limits(panel.image))
        else:
            image = panel.image / panel.residual
        mapping = panel.grid.map_to(like)
        show_image(axes, image, mapping, residual=panel.residual is not None)
        axes.set_title(panel.title, color=INK, fontsize=10, pad=5)
        axes.set_xlabel(panel.note, color=INK, fontsize=8, labelpad=5)
        if i == 0:
            scale_bar(axes, like)
    write_png(path, figure)


def write_png(path, figure):
    """Writes a figure as a PNG of 256 colours, whole or not at all. Raises FileError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image  # comes with matplotlib

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
    sample = Image.fromarray(np.ascontiguousarray(pixels[::SAMPLE_STEP, ::SAMPLE_STEP]))
    palette = sample.quantize(
        N_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=KMEANS_ROUNDS, dither=Image.Dither.NONE
    )
    few = Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)
    with atomic_file(path) as part:
        few.save(part, format="png")
