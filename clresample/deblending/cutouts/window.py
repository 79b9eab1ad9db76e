"""Rows and columns of an observation that hold a source: by its light, or of a given size."""

from __future__ import annotations

import numpy as np
from astropy import units as u

# [noise of a pixel] Model light at the edge of a cutout: ten such pixels beyond the edge add up to
# less than the noise of one pixel.
FAINTEST_SIGMA = 0.1
# The same relative to the model's brightest pixel, if that is more, because of bright stars' wings.
FAINTEST_PART = 1e-4
# [px] Sky about that light; [FWHM of the PSF] least distance of a cutout's edge from the source.
MARGIN_PX, MIN_HALF_FWHM = 2, 2.0


def window_of(own, weights, position, fwhm_px):
    """First and one-past-last row and column (y0, x0, y1, x1) [px] that hold a source's light.

    own (C, Ny, Nx) [counts]: its model; weights (C, Ny, Nx) [counts^-2]
    position (2,) [px]: (y, x) of the source; fwhm_px: of the observation's PSF
    """
    n_y, n_x = own.shape[1:]
    lit = np.zeros((n_y, n_x), bool)
    for image, weight in zip(own, weights, strict=True):
        good = weight > 0
        if good.any() and image.max(initial=0) > 0:
            sigma = np.median(weight[good]) ** -0.5
            lit |= image > max(FAINTEST_SIGMA * sigma, FAINTEST_PART * image.max())
    low, high = np.array(position, float), np.array(position, float)
    low, high = low - MIN_HALF_FWHM * fwhm_px, high + MIN_HALF_FWHM * fwhm_px
    if lit.any():
        for k, axis in enumerate((1, 0)):
            at = np.flatnonzero(lit.any(axis=axis))
            low[k] = min(low[k], at[0] - MARGIN_PX)
            high[k] = max(high[k], at[-1] + MARGIN_PX)
    (y0, x0), (y1, x1) = np.rint(low).astype(int), np.rint(high).astype(int) + 1
    return max(int(y0), 0), max(int(x0), 0), min(int(y1), n_y), min(int(x1), n_x)


def sized_window(size, position, pixel_scale_arcsec):
    """The window of a given size about a position; parts of it may lie outside of the image.

    size: one number or (ny, nx) [px], or Quantities of angle
    Raises ValueError for a size that is not positive, or of another unit.
    """
    shape = size_px(size, pixel_scale_arcsec)
    first = [int(np.rint(at - (n - 1) / 2)) for at, n in zip(position, shape, strict=True)]
    return *first, first[0] + shape[0], first[1] + shape[1]


def size_px(size, pixel_scale_arcsec) -> tuple[int, int]:
    """(ny, nx) [px] of a size: numbers of pixels, or Quantities of angle."""
    try:
        several = isinstance(size, (tuple, list))
        with_unit = any(isinstance(one, u.Quantity) for one in (size if several else [size]))
        given = u.Quantity(size) if with_unit else np.asarray(size)
        if isinstance(given, u.Quantity):
            in_px = given.unit.is_equivalent(u.pix)
            given = given.to_value(u.pix) if in_px else given.to_value(u.arcsec)
            given = given if in_px else np.ceil(given / pixel_scale_arcsec - 1e-6)
        sides = np.broadcast_to(np.asarray(given, float), 2)
    except (u.UnitConversionError, TypeError, ValueError):
        sides = np.zeros(2)
    if not (np.isfinite(sides) & (sides >= 1) & (sides == np.rint(sides))).all():
        raise ValueError(
            f"size is {size!r}, must be one or two whole numbers of pixels (ny, nx) above 0, or "
            "angles such as 5 * u.arcsec"
        )
    return int(sides[0]), int(sides[1])
