"""Converts astropy's NDData, CCDData and Cutout2D to arguments of an Observation."""

from __future__ import annotations

import numpy as np
from astropy.nddata import (
    Cutout2D,
    InverseVariance,
    NDData,
    StdDevUncertainty,
    VarianceUncertainty,
)


def is_container(image) -> bool:
    """Returns True if an object is an image with a WCS of its own."""
    return isinstance(image, NDData | Cutout2D)


def arguments_of(image, psf, given) -> dict:
    """Arguments of Observation, by name, for an image and the options passed with it.

    Raises ValueError for an image without a WCS or a PSF, or with an unknown kind of uncertainty.
    """
    kind = type(image).__name__
    wcs = getattr(image, "wcs", None)
    if wcs is None:
        raise ValueError(
            f"image, of type {kind}, has no wcs: set it, or give "
            "Observation(image.data, psf, Grid.flat(shape, scale_arcsec))"
        )
    psf = getattr(image, "psf", None) if psf is None else psf
    if psf is None:
        raise ValueError(f"image, of type {kind}, has no psf: give from_nddata(image, psf)")
    found = {"data": np.asarray(image.data), "psf": psf, "grid": wcs}
    if getattr(image, "mask", None) is not None:
        found["mask"] = np.asarray(image.mask)
    if getattr(image, "unit", None) is not None:
        found["unit"] = image.unit
    return found | _noise(image, given) | given


def _noise(image, given):
    """Weights or variance from the image's uncertainty; empty if the caller passed them."""
    uncertainty = getattr(image, "uncertainty", None)
    if uncertainty is None or {"weights", "variance"} & set(given):
        return {}
    values = np.asarray(uncertainty.array, np.float64)
    if uncertainty.unit is not None and image.unit is not None:
        values = values * uncertainty.unit
    if isinstance(uncertainty, StdDevUncertainty):
        return {"variance": values**2}
    if isinstance(uncertainty, VarianceUncertainty):
        return {"variance": values}
    if isinstance(uncertainty, InverseVariance):
        return {"weights": values}
    raise ValueError(
        f"image.uncertainty is {type(uncertainty).__name__}: it must be a standard deviation, a "
        "variance or an inverse variance, or give `variance`"
    )
