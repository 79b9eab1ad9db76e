"""Units of images: flux densities, which imply zero points, and counts."""

from __future__ import annotations

import numpy as np
from astropy import units as u

from .checks import to_unit
from .derived import ZERO_POINT_UJY

# What detectors count; a count per second is a count as well.
COUNTS = (u.dimensionless_unscaled, u.adu, u.electron, u.ct, u.DN, u.photon)
# [mag] Zero points that differ by more than this are two statements.
SAME_MAG = 1e-6


def take_unit(data, unit):
    """Splits data into plain values and their unit; converts them if `unit` is another one.

    unit: an astropy unit or its name, for data without one; None = that of the data, if any
    returns the plain data, and the astropy unit or None

    Raises ValueError for an invalid unit, and for data that cannot be converted to it.
    """
    own = getattr(data, "unit", None)
    if unit is None and own is None:
        return data, None
    try:
        unit = u.Unit(own if unit is None else unit)
    except (ValueError, TypeError) as error:
        raise ValueError(f"unit is {unit!r:.80}, must be a unit of astropy: {error}") from None
    return (data if own is None else to_unit("data", data, unit)), unit


def flux_unit(unit):
    """Unit of flux density of an image in `unit`, without "per pixel"; None for counts.

    Raises ValueError for units that are neither.
    """
    if unit is None or any(unit in (count, count / u.s) for count in COUNTS):
        return None
    for of_pixel in (unit, unit * u.pix):
        if of_pixel.is_equivalent(u.uJy):
            return of_pixel
    way = "convert it, or give plain numbers and zero_points"
    if (unit * u.sr).is_equivalent(u.uJy):
        way = "multiply it by the solid angle of a pixel"
    raise ValueError(f"data has the unit {unit}, neither a flux density nor counts: {way}")


def zero_points_of(unit, given, n_channels):
    """Zero points (C,) [mag] implied by a unit of flux density; those passed if it is None.

    Raises ValueError if the zero points passed contradict the unit.
    """
    if unit is None:
        return given
    own = np.full(n_channels, ZERO_POINT_UJY - 2.5 * np.log10(unit.to(u.uJy)))
    own.flags.writeable = False
    if given is None:
        return own
    if np.abs(given - own).max() > SAME_MAG:
        raise ValueError(
            f"zero_points is {given}, but data has the unit {unit}, whose zero point is "
            f"{own[0]:.6g}: give one of them"
        )
    return given
