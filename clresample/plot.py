"""Pictures of images side by side on one sky: asinh-stretched panels, residuals, a scale bar."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from .grid import Grid

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
        _show(axes, panel, like)
        axes.set_title(panel.title, color=INK, fontsize=10, pad=5)
        axes.set_xlabel(panel.note, color=INK, fontsize=8, labelpad=5)
        if i == 0:
            _scale_bar(axes, like)
    _write_png(Path(path), figure)


class Comparison(NamedTuple):
    """How a rendered image agrees with an observed one: observed = scale * rendered + level.

    correlation: Pearson's, over `mask` (My, Mx): pixels one PSF width inside the coverage
    residual (My, Mx): observed - scale * rendered - level, NaN outside the coverage
    """

    correlation: float
    scale: float
    level: float
    residual: np.ndarray
    mask: np.ndarray


def compare(rendered, observed, covered, width_px):
    """Fit one flux scale and one sky level, the units of two instruments being what they are.

    rendered, observed (My, Mx); covered (My, Mx) bool
    width_px [px]: what lies nearer to the edge of the coverage lacks light from outside
    Returns None where fewer than three pixels compare, or one image is constant.
    """
    inside = distance_transform_edt(np.pad(covered, 1))[1:-1, 1:-1] > width_px
    mask = inside & np.isfinite(observed)
    x, y = (image[mask].astype(np.float64) for image in (rendered, observed))
    if x.size < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    scale, level = np.polyfit(x, y, 1)
    residual = np.where(covered, observed - scale * rendered - level, np.nan)
    return Comparison(float(np.corrcoef(x, y)[0, 1]), scale, level, residual, mask)


def fwhm_px(psf):
    """Width [px] of the first band's core: diameter of the disc above half its maximum."""
    image = psf.images[0]
    return 2 * np.sqrt(np.count_nonzero(image > image.max() / 2) / np.pi) * psf.spacing


def plot_resampled(path, image, reference, result, covered, psf_out, *, names, title=""):
    """Draw the first band of an image, of its resampling and, if the bands match, of the reference.

    image, reference: as `read_image` returns them; result (C, My, Mx), covered (My, Mx)
    names (2,): what the image and the reference are called; title: above the row
    Returns the Comparison, or None.
    """
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    grid = reference.grid.cutout(rows[0], columns[0], covered[box].shape)
    rendered = np.where(covered, result[0], np.nan)
    scales = image.grid.pixel_scale_arcsec, grid.pixel_scale_arcsec
    seen = f"{names[0]} as {names[1]} sees it"
    panels = [
        Panel(image.data[0], image.grid, names[0], f"{scales[0]:.3g}″ pixels"),
        Panel(rendered[box], grid, seen, f"{scales[1]:.3g}″ pixels"),
    ]
    comparison = None
    if len(reference.data) == len(result):
        comparison = compare(result[0], reference.data[0], covered, fwhm_px(psf_out))
    if comparison:
        limits = stretch_limits(reference.data[0][box])
        same = tuple(
            np.subtract(limits, (comparison.level, 0, comparison.level)) / comparison.scale
        )
        panels[1] = Panel(rendered[box], grid, seen, panels[1].note, limits=same)
        sigma = noise_level(comparison.residual[comparison.mask])[1]
        panels += [
            Panel(reference.data[0][box], grid, names[1], "as observed", limits=limits),
            Panel(
                comparison.residual[box],
                grid,
                "difference",
                f"correlation {comparison.correlation:.4f}; colours: ±{RESIDUAL_SIGMAS} sigma",
                residual=RESIDUAL_SIGMAS * sigma,
            ),
        ]
    save_panels(path, panels, like=grid, title=title)
    return comparison


def _write_png(path, figure):
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


def _show(axes, panel, like):
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


def _scale_bar(axes, like):
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
