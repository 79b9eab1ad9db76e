"""Validates a user's numbers, arrays and objects; a ValueError names the argument.

NumPy converts much to floats silently: it drops or reinterprets an imaginary part, a unit, a mask,
a date or a text. These functions respect each of them, or raise a ValueError.
"""

from __future__ import annotations

import math
import numbers as kinds
from decimal import Decimal

import numpy as np

# kinds of NumPy types that are real numbers: bool, integers, floats
REAL = "biuf"
# How a user makes the objects that arguments must be, for messages.
WAYS = {
    "Grid": "Grid.from_wcs(wcs, shape) or Grid.flat(shape, scale_arcsec)",
    "PSF": "PSF(array) or read_psf(path)",
    "PSFField": "FunctionPSF(function)",
    "Source": "ExtendedSource(sky_deg=(ra, dec))",
    "FitSettings": "Settings(max_iter=100)",
    "Observation": "Observation(data, psf, grid) or Observation.from_nddata(image, psf)",
    "Blend": "Blend(observations, sources)",
    "Result": "a result of deblend, or one of deblend_many",
    "Frame": "model_frame(observations)",
    "Mosaic": "Mosaic.of_arrays(name, data, psf, grid), or those of read_field",
    "CCDData": "cutouts of Result.cutout or FieldCutouts.cutout",
    "Table": "catalogue(result)",
}
# Public classes in place of their base class, for messages.
PUBLIC = {"Source": "ExtendedSource or PointSource", "FitSettings": "Settings or PaperSettings"}


def as_float_array(name, values, unit=None) -> np.ndarray:
    """Converts values of any shape to float64.

    unit: the unit that values with a unit (astropy's Quantity) are converted to; None permits no
        unit

    Raises ValueError for complex numbers, texts, dates, masked values, and other units.
    """
    with np.errstate(invalid="ignore"):  # damaged files may contain signalling NaN
        return np.asarray(as_real_array(name, values, unit), dtype=np.float64)


def as_real_array(name, values, unit=None) -> np.ndarray:
    """Converts values like `as_float_array`, but keeps the type of real numbers."""
    if type(values) is np.ndarray and values.dtype.kind in REAL:
        return values
    values = to_unit(name, values, unit)
    mask = mask_of(values)
    if mask is not None and mask.any():
        raise ValueError(
            f"{name} is masked at {np.count_nonzero(mask)} of {mask.size} values: fill them first"
        )
    try:
        array = np.asarray(getattr(values, "unmasked", values))
        check_real(name, array)
        return array.astype(np.float64) if array.dtype.kind == "O" else array
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{name} must be an array of real numbers: {error}") from None
    except ValueError as error:
        if str(error).startswith(name):
            raise
        raise ValueError(f"{name} must be an array of real numbers: {error}") from None


def check_real(name, array):
    """Raises ValueError, naming the array `name`, unless its values are real numbers."""
    if array.dtype.kind in REAL:
        return
    if array.dtype.kind == "O":
        for value in array.flat:
            if not isinstance(value, (kinds.Real, np.bool_, Decimal)):
                raise ValueError(f"{name} must be an array of real numbers, it holds {value!r:.80}")
        return
    raise ValueError(f"{name} must be an array of real numbers, not of type {array.dtype}")


def to_unit(name, values, unit=None):
    """Converts values with a unit to `unit`. Raises ValueError for an incompatible unit."""
    if isinstance(values, list | tuple) and any(hasattr(value, "unit") for value in values):
        return [to_unit(name, value, unit) for value in values]
    given = getattr(values, "unit", None)
    if given is None or str(given) == "":
        return values
    if unit is not None and hasattr(values, "to_value"):
        try:
            return values.to_value(unit)
        except Exception as error:  # astropy raises a class of its own
            raise ValueError(f"{name} has the unit {given}, not {unit}: {error}") from None
    way = f" in {unit}" if unit else ""
    raise ValueError(f"{name} has the unit {given}: give plain numbers{way}, such as its .value")


def mask_of(values):
    """Mask of values (bool, of their shape); None for types without masks."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.getmaskarray(values)
    if hasattr(values, "unmasked") and hasattr(values, "mask"):  # astropy's Masked
        return np.broadcast_to(np.asarray(values.mask, dtype=bool), np.shape(values))
    return None


def split_mask(name, values):
    """Fills masked values with 0; also returns their mask, None without any."""
    mask = mask_of(values)
    if mask is None:
        return values, None
    values = to_unit(name, values)
    plain = np.asarray(values.unmasked if hasattr(values, "unmasked") else np.ma.getdata(values))
    check_real(name, plain)
    return (np.where(mask, 0, plain), mask) if mask.any() else (plain, None)


def check_number(name, value, what="a finite number", fits=math.isfinite) -> float:
    """Returns one number as a float. Raises ValueError unless `fits`, described by `what`."""
    found = as_float_array(name, np.nan if isinstance(value, str) else value)
    if found.shape != () or not fits(float(found)):
        raise ValueError(f"{name} is {plain_repr(value):.80}, must be {what}")
    return float(found)


def check_integer(name, value, least=0) -> int:
    """Returns an integer of at least `least`. Raises ValueError for any other value."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ValueError(
            f"{name} is {plain_repr(value):.80}, must be a whole number, {least} or more"
        )
    if value < least:
        raise ValueError(f"{name} is {value}, must be {least} or more")
    return int(value)


def check_dtype(dtype) -> np.dtype:
    """Returns NumPy's type of float32 or float64. Raises ValueError for others, and None."""
    try:
        found = None if dtype is None else np.dtype(dtype)
    except TypeError:
        found = None
    # NumPy's types compare equal to their names, and to None, which means float64
    if found is None or found.kind != "f" or found.itemsize not in (4, 8):
        raise ValueError(f"dtype is {dtype!r:.80}, must be float32 or float64")
    return found


def check_instance(name, value, kind):
    """Returns the value. Raises ValueError unless it is an instance of a class, or of several."""
    if isinstance(value, kind):
        return value
    wanted = kind if isinstance(kind, tuple) else (kind,)
    ways = [WAYS[k.__name__] for k in wanted if k.__name__ in WAYS]
    names = [PUBLIC.get(k.__name__, k.__name__) for k in wanted]
    raise ValueError(
        f"{name} is {described(value)}, must be {' or '.join(names)}"
        + (f": give {' or '.join(ways)}" if ways else "")
    )


def check_sequence(name, values, kind=object) -> tuple:
    """Returns the values as a tuple. Raises ValueError for one alone, and unless all are `kind`."""
    try:
        values = tuple(values)
    except TypeError:
        raise ValueError(
            f"{name} is {described(values)}, must be a sequence: give a list"
        ) from None
    for i, value in enumerate(values):
        check_instance(f"{name}[{i}]", value, kind)
    return values


def plain_repr(value) -> str:
    """The repr of a value for messages; that of a NumPy scalar is its number's."""
    return repr(value.item() if isinstance(value, np.generic) else value)


def described(value) -> str:
    """Describes a value in a few words for messages; arrays by type and shape alone."""
    kind, shape = type(value).__name__, getattr(value, "shape", None)
    if shape is not None and np.ndim(shape) == 1 and len(shape):
        return f"of type {kind} and shape {tuple(shape)}"
    text = plain_repr(value)
    if isinstance(value, str | int | float | bool | None):
        return f"{text:.80} ({kind})"
    if "\n" in text or len(text) > 80:
        return f"of type {kind}"
    return f"{text} ({kind})"


def check_image_shape(shape):
    """Returns (Ny, Nx) as a tuple of int. Raises ValueError for anything else."""
    found = as_float_array("shape", shape)
    if found.shape != (2,) or not (found >= 1).all() or (found != np.rint(found)).any():
        raise ValueError(f"shape must be (Ny, Nx), each at least 1 pixel, not {shape}")
    return int(found[0]), int(found[1])


def check_pixel_scale(name, values):
    """Returns two numbers [arcsec], from one or two. Raises ValueError for anything else."""
    found = as_float_array(name, values, "arcsec")
    if found.shape not in ((), (2,)) or not np.isfinite(found).all():
        raise ValueError(f"{name} is {values!r:.80}, must be one or two finite numbers")
    return np.broadcast_to(found, 2)


class ReadOnly:
    """Mixin: arrays of its instances are read-only, also in copies and after unpickling."""

    def __setstate__(self, state):
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        self.__dict__.update(state)
