"""Cutouts of many sources in one FITS file, and back, as astropy's CCDData."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import Table

from ..sky.validation.checks import check_sequence
from .array_hdus import array_of
from .atomic import FileError, check_output
from .fits import add_provenance, celestial_header, open_fits, write_hdus
from .fits_names import to_ascii

NAMES = {"hdu_mask": "MASK", "hdu_uncertainty": "UNCERT", "hdu_psf": "PSFIMAGE"}
COLUMNS = ("source", "observation", "what", "ny", "nx")


def write_cutouts(path, cutouts, *, overwrite=False, device=None, inputs=None):
    """Writes cutouts into one FITS file, whole or not at all.

    HDUs: CUTOUTS, a table with a row for each: source, observation, what it is, ny and nx [px];
    and of cutout k, from 1 on, with EXTVER = k: DATA with WCS and unit, UNCERT (standard
    deviation), MASK (1 = ignore) and PSFIMAGE; float32. `CCDData.read(path, hdu=("DATA", k),
    hdu_mask=("MASK", k), hdu_uncertainty=("UNCERT", k), hdu_psf=("PSFIMAGE", k))` reads one.

    cutouts: CCDData, as `Result.cutout` and `FieldCutouts.cutout` return them; at least one
    device: name of the OpenCL device; inputs: {what: file}; both for the header
    overwrite: replace a file that exists

    Raises FileError when it exists or cannot be written, ValueError for no cutout.
    """
    path, cutouts = Path(path), check_sequence("cutouts", cutouts, CCDData)
    check_output(path, overwrite=overwrite)
    if not cutouts:
        raise ValueError("cutouts is empty, must hold one or more")
    primary = fits.PrimaryHDU()
    add_provenance(primary.header, np.dtype(np.float32), device, inputs or {}, None)
    rows = [
        (
            to_ascii(str(c.meta.get("OBJECT", ""))),
            to_ascii(str(c.meta.get("INSTRUME", ""))),
            str(c.meta.get("CUTKIND", "")),
            *c.shape[-2:],
        )
        for c in cutouts
    ]
    table = fits.table_to_hdu(Table(rows=rows, names=COLUMNS))
    table.name = "CUTOUTS"
    hdus = [primary, table]
    for k, one in enumerate(cutouts, start=1):
        data, *more = one.to_hdu(**NAMES)
        for hdu, name in ((data, "DATA"), *((h, h.name) for h in more)):
            image = hdu.data.astype(np.float32) if hdu.data.dtype.kind == "f" else hdu.data
            hdus.append(fits.ImageHDU(image, hdu.header, name=name, ver=k))
    write_hdus(path, hdus)


def read_cutouts(path) -> list[CCDData]:
    """Reads the cutouts that `write_cutouts` or `clresample cutout` wrote: a list of CCDData.

    path: of the FITS file
    Raises FileError if the file does not exist, is damaged, or contains no cutouts.
    """
    with open_fits(path) as hdus:
        if "CUTOUTS" not in hdus:
            raise FileError(f"{path}: holds no cutouts (no HDU CUTOUTS)")
        return [_read(path, hdus, k) for k in range(1, len(hdus["CUTOUTS"].data) + 1)]


def _read(path, hdus, k):
    """Cutout k of an open file."""
    header = hdus["DATA", k].header
    data, *parts = (
        array_of(hdus[name, k]) if (name, k) in hdus else None for name in ("DATA", *NAMES.values())
    )
    mask, sigma, psf = parts
    return CCDData(
        data,
        unit=header["BUNIT"],
        wcs=celestial_header(path, header, hdus),
        mask=None if mask is None else mask.astype(bool),
        uncertainty=None if sigma is None else StdDevUncertainty(sigma),
        psf=psf,
        meta=header.copy(),
    )
