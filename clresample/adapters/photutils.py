"""PSF models of photutils as our PSFs: GriddedPSFModel, ImagePSF and its analytic ones."""

from __future__ import annotations

import numpy as np

from ..sky.psf import PSF
from .optional import require


def psf_of(model, *, position_px=(0.0, 0.0), n_pixels=41, oversampling=None) -> PSF:
    """The PSF of a photutils model at one position.

    photutils' models return flux per pixel at any offset from the centre, pixel response included.
    So their samples on a finer grid are images for `PSF(images, spacing=...)`.

    model: a two-dimensional model with parameters x_0, y_0 and flux; a list of C makes C bands
    position_px (2,) [px]: (y, x), used by a GriddedPSFModel, which varies over its image
    n_pixels: side of the images [pixels]; light beyond is cut off
    oversampling: samples per pixel and axis; None = that of the model, or 1 if it has none

    Raises ImportError without photutils; ValueError for a model that is not of that kind.
    """
    require("photutils", "photutils")
    models = model if isinstance(model, (list, tuple)) else [model]
    if oversampling is None:
        own = {int(n) for m in models for n in np.ravel(getattr(m, "oversampling", 1))}
        oversampling = max(own)
    side = int(round(n_pixels * oversampling)) // 2 * 2 + 1
    offsets = (np.arange(side) - side // 2) / oversampling
    y, x = np.asarray(position_px, np.float64)
    images = []
    for each in models:
        if not {"x_0", "y_0", "flux"} <= set(getattr(each, "param_names", ())):
            raise ValueError(
                f"model is {type(each).__name__}: its parameters must include x_0, y_0 and flux"
            )
        placed = each.copy()
        placed.x_0, placed.y_0, placed.flux = x, y, 1
        images.append(placed(*np.meshgrid(x + offsets, y + offsets)))
    return PSF(np.array(images), spacing=1 / oversampling)
