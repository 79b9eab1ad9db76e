"""Pieces that the figures share: dark sheets of panels, stretches, and small PNG files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.grid import Grid
from ..sky.noise import background
from .whole_file import whole_file

PANEL_INCHES, DPI = 2.75, 160  # a row of four panels fills a page's width
INK, PAPER, EDGE = "#e8eaf0", "#10131a", "#3a4152"  # text, background, a panel's frame
SKY_COLOURS, RESIDUAL_COLOURS = "inferno", "RdBu_r"
GAP = 0.06  # [inch] between panels
BAR_FRACTION = 0.3  # of a panel's width: the scale bar is shorter
# of the pixels: shown as white, so that one hot pixel does not darken the others
BRIGHT_QUANTILE = 0.9995
RESIDUAL_SIGMAS = 10  # [sigma of its background] at which a residual's colours end
# Colours of a PNG: a third of the size of a file of all colours, with differences of 3 of 256 rms.
# They are chosen from every fourth pixel of every fourth row, 7 times faster than from all pixels
# and as near to the drawing; sparser samples lose the colour of thin lines.
N_COLOURS, SAMPLE_STEP = 256, 4
KMEANS_ROUNDS = 4  # that move the colours to the means of the pixels they stand for
NO_MATPLOTLIB = "pictures need matplotlib, which is not installed: pip install 'clresample[plot]'"


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
    median, sigma = background(image)
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
        raise ImportError(NO_MATPLOTLIB) from error
    return Figure


def dark_sheet(width, height, title=""):
    """A dark figure of this size [inches] with a title in its upper left corner."""
    figure = import_figure()(figsize=(width, height), dpi=DPI, facecolor=PAPER)
    place = {"x": GAP / width, "y": 1 - 0.1 / height, "ha": "left", "va": "top"}
    figure.text(s=title, color=INK, fontsize=11, weight="bold", **place)
    return figure


def add_panel(figure, left, top, width, height):
    """Axes of this place and size [inches], counted from the figure's upper left corner."""
    across, down = figure.get_size_inches()
    box = left / across, 1 - (top + height) / down, width / across, height / down
    return figure.add_axes(box, facecolor=PAPER)


def show_image(axes, image, mapping, *, residual=False):
    """Draw an image in the place and orientation that it has on other pixels.

    image (My, Mx): 0 ... 1 in the colours of the sky, or -1 ... 1 in those of a residual; or
        (My, Mx, 3) red, green and blue of 0 ... 1
    mapping: of its pixels to those (Ny, Nx) that fill the axes
    """
    from matplotlib.transforms import Affine2D

    (a, b), (c, d) = mapping.matrix  # rows (y, x), columns (n, m)
    t_y, t_x = mapping.offset
    (m_y, m_x), (n_y, n_x) = mapping.shape_out, mapping.shape_in
    axes.imshow(
        image,
        cmap=RESIDUAL_COLOURS if residual else SKY_COLOURS,
        vmin=-1 if residual else 0,
        vmax=1,
        origin="lower",
        interpolation="nearest",
        extent=(-0.5, m_x - 0.5, -0.5, m_y - 0.5),
        transform=Affine2D.from_values(d, b, c, a, t_x, t_y) + axes.transData,
    )
    axes.set(xlim=(-0.5, n_x - 0.5), ylim=(-0.5, n_y - 0.5), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(EDGE)


def scale_bar(axes, like):
    """A bar of a round number of arcsec in the lower left corner."""
    scale = like.pixel_scale_arcsec
    longest = BAR_FRACTION * like.shape[1] * scale
    power = 10 ** np.floor(np.log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    x0, y0 = 0.05 * np.array(like.shape[::-1]) - 0.5
    axes.plot([x0, x0 + length / scale], [y0, y0], color="white", lw=1.6, solid_capstyle="butt")
    text = f"{length / 60:g}′" if length >= 60 else f"{length:g}″"
    place = x0 + length / scale / 2, y0 + 0.015 * like.shape[0]
    axes.text(*place, text, color="white", fontsize=8, ha="center", va="bottom")


def save_panels(path, panels, *, like: Grid, title=""):
    """Write a row of panels as a PNG, each in the place and orientation that it has on `like`.

    path: the file, written whole or not at all; panels: list of Panel
    like: the pixels that fill every panel's frame; title: above the row

    Raises ImportError, with what to install, without matplotlib; FileError where the file cannot be
    written.
    """
    n_y, n_x = like.shape
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    above, below = (0.64 if title else 0.36), 0.36  # inches for the text
    figure = dark_sheet(len(panels) * (width + GAP) + GAP, height + above + below, title)
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
    """Write a figure as a PNG of 256 colours, whole or not at all. Raises FileError."""
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
    with whole_file(path) as part:
        few.save(part, format="png")
