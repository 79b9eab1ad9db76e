"""Figures of PSFs and observations, one panel a band, and of detections."""

from __future__ import annotations

import numpy as np

from .figure import GAP, INK, add_panel, dark_figure, limits_of, scale_bar, stretch

PANEL_INCHES, MAX_IN_A_ROW = 2.2, 6
DETECTION_INCHES = 5.0
MARK = "#7fe3ff"
ABOVE, BELOW = 0.56, 0.32  # [inch] for a row's titles and notes
PSF_DECADES = 4  # of brightness below a PSF's peak that are shown
BRIGHT_QUANTILE = 0.999  # of an image's pixels: shown as white
COLOURS = "inferno"


def psf_figure(psf, title=""):
    """Every band of a PSF, in four decades of brightness; crosses mark the centres."""
    figure, panels = _panels(psf.images.shape, title)
    for k, (axes, image) in enumerate(zip(panels, psf.images, strict=True)):
        floor = image.max() * 10.0**-PSF_DECADES
        axes.imshow(np.log10(np.maximum(image, floor)), cmap=COLOURS, origin="lower")
        axes.plot(*psf.center[k][::-1], "+", color=MARK, ms=9, mew=0.8)
        _label(axes, f"band {k}", f"FWHM {psf.fwhm_px[k]:.2f} px")
    return figure


def observation_figure(observation, title=""):
    """Every channel of an observation, linear in the noise; pixels without weight are blank."""
    o = observation
    figure, panels = _panels(o.data.shape, title or o.name or "")
    for k, (axes, image, weights) in enumerate(zip(panels, o.data, o.weights, strict=True)):
        seen = weights > 0
        level = float(np.median(image[seen])) if seen.any() else 0.0
        sigma = float(np.median(weights[seen])) ** -0.5 if seen.any() else 1.0
        shown = np.where(seen, image, np.nan)
        white = float(np.nanquantile(shown, BRIGHT_QUANTILE)) if seen.any() else 1.0
        axes.imshow(stretch(shown, limits_of(level, sigma, white)), cmap=COLOURS, origin="lower")
        _label(axes, o.channels[k], f"noise {sigma:.3g} {o.unit or 'counts'}")
        if k == 0:
            scale_bar(axes, o.grid)
    return figure


def detection_sheet(detection, title=""):
    """Signal to noise of a Detection, linear up to some sigma, with a cross at each source."""
    image = detection.image
    n_y, n_x = image.shape
    height = DETECTION_INCHES * n_y / n_x
    figure = dark_figure(DETECTION_INCHES + 2 * GAP, ABOVE / 2 + height + GAP, title)
    axes = add_panel(figure, GAP, ABOVE / 2, DETECTION_INCHES, height)
    seen = image != 0
    white = float(np.quantile(image[seen], BRIGHT_QUANTILE)) if seen.any() else 1.0
    shown = np.where(seen, image, np.nan)
    axes.imshow(stretch(shown, limits_of(0.0, 1.0, white)), cmap=COLOURS, origin="lower")
    for y, x in detection.frame.positions_of(detection.sources):
        axes.plot(x, y, "+", color=MARK, ms=5, mew=0.7)
    axes.set(xlim=(-0.5, n_x - 0.5), ylim=(-0.5, n_y - 0.5), xticks=[], yticks=[])
    return figure


def _panels(shape, title):
    """A dark sheet with a panel for each of C images (C, Ny, Nx), six in a row."""
    n, n_y, n_x = shape
    n_rows, n_columns = -(-n // MAX_IN_A_ROW), min(n, MAX_IN_A_ROW)
    width, height = PANEL_INCHES, PANEL_INCHES * n_y / n_x
    row = ABOVE / 2 + height + BELOW
    figure = dark_figure(n_columns * (width + GAP) + GAP, ABOVE / 2 + n_rows * row, title)
    places = [divmod(k, MAX_IN_A_ROW) for k in range(n)]
    return figure, [
        add_panel(figure, GAP + j * (width + GAP), ABOVE + i * row, width, height)
        for i, j in places
    ]


def _label(axes, title, note):
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, color=INK, fontsize=9, pad=4)
    axes.set_xlabel(note, color=INK, fontsize=8, labelpad=3)
