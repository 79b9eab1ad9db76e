"""Pictures of images side by side on one sky: asinh-stretched panels, residuals, a scale bar."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from ..sky.noise import background
from .panels import RESIDUAL_SIGMAS, Panel, save_panels, stretch_limits


class Comparison(NamedTuple):
    """Fit of a rendered image to an observed one: observed = scale * rendered + level.

    correlation: Pearson's, over `mask` (My, Mx): pixels one PSF width inside the coverage
    residual (My, Mx): observed - scale * rendered - level, NaN outside the coverage
    """

    correlation: float
    scale: float
    sky_level: float
    residual: np.ndarray
    mask: np.ndarray


def compare(rendered, observed, covered, width_px):
    """Fits one flux scale and one sky level: two instruments count in different units.

    rendered, observed (My, Mx); covered (My, Mx) bool
    width_px [px]: pixels nearer to the edge of the coverage are left out, since they lack the light
        of sources outside
    returns Comparison, or None where fewer than three pixels compare, or one image is constant.
    """
    inside = distance_transform_edt(np.pad(covered, 1))[1:-1, 1:-1] > width_px
    mask = inside & np.isfinite(observed)
    x, y = (image[mask].astype(np.float64) for image in (rendered, observed))
    if x.size < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    scale, level = np.polyfit(x, y, 1)
    residual = np.where(covered, observed - scale * rendered - level, np.nan)
    return Comparison(float(np.corrcoef(x, y)[0, 1]), scale, level, residual, mask)


def plot_resampled(path, image, reference, result, covered, psf_out, *, names, title=""):
    """Draws the first band of an image, its resampling and, if bands match, the reference.

    image, reference: as `read_image` returns them; result (C, My, Mx), covered (My, Mx)
    psf_out: the reference's PSF; names (2,): of the image and of the reference, for the titles
    title: above the row
    returns Comparison, or None where there is none

    Raises ImportError, with what to install, without matplotlib; FileError where the file cannot be
    written.
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
        comparison = compare(result[0], reference.data[0], covered, psf_out.fwhm_px[0])
    if comparison:
        limits = stretch_limits(reference.data[0][box])
        same = tuple(
            np.subtract(limits, (comparison.sky_level, 0, comparison.sky_level)) / comparison.scale
        )
        panels[1] = Panel(rendered[box], grid, seen, panels[1].note, limits=same)
        sigma = background(comparison.residual[comparison.mask])[1]
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
