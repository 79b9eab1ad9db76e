"""Dark sheets of panels, and images drawn on them in their place and orientation."""

from __future__ import annotations

import io

import numpy as np

DPI = 160
INK, PAPER, EDGE = "#e8eaf0", "#10131a", "#3a4152"  # text, background, a panel's frame
SKY_COLOURS, RESIDUAL_COLOURS = "inferno", "RdBu_r"
GAP = 0.06  # [inch] between panels
BAR_FRACTION = 0.3  # of a panel's width: the scale bar is shorter
NO_MATPLOTLIB = "pictures need matplotlib, which is not installed: pip install matplotlib"


def limits_of(level, sigma, white):
    """(black, knee, white) of an asinh stretch: linear in the noise, logarithmic in the light.

    level, sigma: of the image's background; white: brightness that is shown as white
    """
    # without noise, or where most is empty: three decades of light, of the level if all is flat
    knee = max(3 * sigma, (white - level) / 1000) or max(abs(level), 1) / 1000
    return level - knee, knee, max(white, level + knee)


def stretch(image, limits):
    """Brightness 0 ... 1:  asinh((I - black) / knee) / asinh((white - black) / knee)."""
    black, knee, white = limits
    return np.clip(np.arcsinh((image - black) / knee) / np.arcsinh((white - black) / knee), 0, 1)


def import_figure():
    """matplotlib's Figure. Raises ImportError that names the package to install."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(NO_MATPLOTLIB) from error
    return Figure


def new_figure(width, height):
    """An empty dark figure of this size [inches], without pyplot: notebooks show it once."""
    figure = import_figure()(figsize=(width, height), dpi=DPI, facecolor=PAPER)
    figure._repr_png_ = lambda: png_of(figure)
    return figure


def png_of(figure, dpi=DPI / 2):
    """A figure as the bytes of a PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()


def dark_figure(width, height, title=""):
    """A dark figure of this size [inches] with a title in its upper left corner."""
    figure = new_figure(width, height)
    place = {"x": GAP / width, "y": 1 - 0.1 / height, "ha": "left", "va": "top"}
    figure.text(s=title, color=INK, fontsize=11, weight="bold", **place)
    return figure


def add_panel(figure, left, top, width, height):
    """Axes of this place and size [inches], counted from the figure's upper left corner."""
    across, down = figure.get_size_inches()
    box = left / across, 1 - (top + height) / down, width / across, height / down
    return figure.add_axes(box, facecolor=PAPER)


def show_image(axes, image, mapping, *, residual=False):
    """Draws an image with its position and orientation on other pixels.

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
