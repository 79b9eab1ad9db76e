"""Stores arrays as image HDUs of FITS files, to the last bit: also empty and unknown values.

Many programs fail on NaN and infinity. So in files the most negative number of the type stands for
NaN and the largest for infinity, which a header card states.
"""

from __future__ import annotations

import json

import numpy as np
from astropy.io import fits


def image_hdu(name, array, cards=None, i=0):
    """An image HDU, number i + 1 of its name; an empty array is described in its header."""
    array = np.asarray(array)
    strange = array.dtype.kind == "f" and not np.isfinite(array).all()
    if strange:
        most = np.finfo(array.dtype).max
        array = np.nan_to_num(array, nan=-most, posinf=most, neginf=-most)
    hdu = fits.ImageHDU(array if array.size else None, cards, name=name, ver=i + 1)
    if strange:
        hdu.header["UNKNOWN"] = (True, "largest number: infinite; its negative: NaN")
    if not array.size:
        hdu.header["EMPTY"] = (json.dumps([array.dtype.name, *array.shape]), "type and shape")
    return hdu


def array_of(hdu):
    """The array of an image HDU that `image_hdu` made."""
    if "EMPTY" in hdu.header:
        dtype, *shape = json.loads(hdu.header["EMPTY"])
        return np.zeros(shape, dtype)
    array = np.array(hdu.data, dtype=hdu.data.dtype.newbyteorder("="))
    if "UNKNOWN" in hdu.header:
        most = np.finfo(array.dtype).max
        array[array == most], array[array == -most] = np.inf, np.nan
    return array
