"""PSF fields of files: images, cubes, cells, PSFEx, Piff, gridded PSFs, Euclid's CATALOG-PSF."""

from __future__ import annotations

import numpy as np

from ...files.atomic import FileError
from ...files.fits import choose_hdu, open_fits, read_pixels, read_psf
from ...sky.psf import PSF
from ...sky.validation.checks import check_instance
from ...sky.varying_psf.field import PSFField
from ..plugins import Formats
from .combined import ConstantPSF
from .gridded import read_gridded
from .piff import STAMP_PX, PiffPSF
from .psfex import PSFExPSF
from .sampled import CellPSF, ScatteredPSF

OWN = ("image", "cube", "cells", "psfex", "piff", "gridded", "euclid-mer")


def read_psf_field(
    path,
    form,
    grid,
    *,
    hdu=None,
    bands=None,
    spacing=1.0,
    center=None,
    stamp_px=STAMP_PX,
    detector=None,
    **cells,
) -> PSFField:
    """The PSF field of a file.

    form: how it is kept
        "image": a FITS image, or a cube of one plane for each band, the same everywhere
        "cube": a FITS image (K, ny, nx) or (K, C, ny, nx) with a table HDU POSITIONS of K rows:
            x and y [px of the mosaic, from 0], or ra and dec [deg]
        "cells": a FITS image (cells_y, cells_x, ny, nx) or (cells_y, cells_x, C, ny, nx), with
            cell_px and origin_px, see CellPSF
        "psfex": a PSFEx file, or a table with a row for each detector, see PSFExPSF
        "piff": a Piff file
        "gridded": a file that photutils' GriddedPSFModel reads, see `read_gridded`
        "euclid-mer": a CATALOG-PSF of Euclid's MER, see `read_mer_sheet`
        or a name that another package adds, see FORMATS
    grid: of the mosaic; hdu: of the image, None = the first; bands: of "image", by number or name
    spacing [px], center: of the samples, see PSF; those of PSFEx, Piff and gridded files are their
        own; stamp_px [px]: side of Piff's stamps
    detector: its number, of Piff and STDPSF files that hold several; of PSFEx, also its name

    Raises FileError, one line that names the file, and ValueError for another form.
    """
    if form not in FORMATS:
        raise ValueError(f"psf_format is {form!r}, must be {', '.join(FORMATS)}")
    samples = {"spacing": spacing, "center": center}
    if form not in OWN:
        given = {"hdu": hdu, "bands": bands, "stamp_px": stamp_px, "detector": detector} | samples
        found = check_instance(
            f"the result of {form!r}", FORMATS[form](path, grid, **given), PSF_KINDS
        )
        return ConstantPSF(found) if isinstance(found, PSF) else found
    if form == "image":
        return ConstantPSF(read_psf(path, hdu=hdu, bands=bands, **samples))
    if form == "psfex":
        return PSFExPSF(path, detector)
    if isinstance(detector, str):
        raise ValueError(f"psf_detector is {detector!r}, must be a whole number for {form} files")
    if form == "piff":
        return PiffPSF(path, detector=detector, stamp_px=stamp_px)
    if form == "gridded":
        return read_gridded(path, detector=detector)
    with open_fits(path) as hdus:
        try:
            if form == "euclid-mer":
                return read_mer_sheet(path, hdus, grid, **samples)
            images = _images(path, hdus, hdu)
            if form == "cells":
                return CellPSF(images, **cells, **samples)
            return ScatteredPSF(images, _positions(path, hdus, "POSITIONS", grid), **samples)
        except FileError:
            raise
        except ValueError as error:
            raise FileError(f"{path}: {error}") from error


# Those of other packages are called as reader(path, grid, **given), with hdu, bands, spacing,
# center, stamp_px and detector as `read_psf_field` has them; they return a PSFField or a PSF.
FORMATS = Formats("clresample.psf_formats", dict.fromkeys(OWN, read_psf_field))
PSF_KINDS = PSFField, PSF


def read_mer_sheet(path, hdus, grid, **samples) -> ScatteredPSF:
    """The stamps of a CATALOG-PSF of Euclid's MER as a ScatteredPSF.

    HDU 1 is a sheet of stamps of STMPSIZE pixels a side (its header says how many), HDU 2 a table
    with x_center and y_center, a stamp's central pixel on the sheet counted from 1, and Ra and Dec
    [deg], from which the mosaic's WCS gives its position: x and y of the table count the pixels of
    the mosaic that the stamps were made for, which may be another one.

    Raises FileError for other HDUs, and where a stamp reaches over the sheet.
    Source: the Euclid data product description of the MER final catalogue's PSFs.
    """
    if len(hdus) < 3 or "STMPSIZE" not in hdus[1].header:
        raise FileError(f"{path}: no CATALOG-PSF, HDU 1 has no STMPSIZE")
    sheet, size = read_pixels(path, hdus[1]), int(hdus[1].header["STMPSIZE"])
    table = hdus[2].data
    missing = [n for n in ("x_center", "y_center", "Ra", "Dec") if n not in table.names]
    if missing:
        raise FileError(f"{path}: HDU 2 has no column {missing[0]}, but {', '.join(table.names)}")
    stamps, half = [], size // 2
    for x, y in zip(table["x_center"], table["y_center"], strict=True):
        y0, x0 = round(float(y)) - 1 - half, round(float(x)) - 1 - half
        stamp = sheet[max(y0, 0) : y0 + size, max(x0, 0) : x0 + size]
        if stamp.shape != (size, size):
            raise FileError(
                f"{path}: the stamp of {size} pixels about ({y}, {x}) is not on the sheet of "
                f"{sheet.shape}"
            )
        stamps.append(stamp)
    places = grid.pixel(np.asarray(table["Ra"], float), np.asarray(table["Dec"], float))
    seen = np.isfinite(places).all(axis=1)
    return ScatteredPSF(np.array(stamps, np.float32)[seen], places[seen], **samples)


def _images(path, hdus, hdu):
    """The pixels of an HDU of any number of axes."""
    if hdu is None:
        found = [one for one in hdus if one.is_image and len(one.shape) >= 3]
        if not found:
            raise FileError(f"{path}: no HDU holds PSF images of three axes or more")
        return read_pixels(path, found[0])
    if isinstance(hdu, str) and hdu in hdus:
        return read_pixels(path, hdus[hdu])
    if isinstance(hdu, int) and hdu < len(hdus):
        return read_pixels(path, hdus[hdu])
    return read_pixels(path, choose_hdu(path, hdus, hdu))


def _positions(path, hdus, name, grid):
    """Positions (K, 2) [px], (y, x), of a table HDU."""
    if name not in hdus:
        raise FileError(f"{path}: a cube of PSFs needs a table HDU {name} with x and y, or ra, dec")
    table = hdus[name].data
    names = {column.lower(): column for column in table.names}
    if "x" in names and "y" in names:
        return np.stack([table[names["y"]], table[names["x"]]], axis=1).astype(float)
    if "ra" in names and "dec" in names:
        return grid.pixel(np.asarray(table[names["ra"]]), np.asarray(table[names["dec"]]))
    raise FileError(f"{path}: HDU {name} has neither x and y nor ra and dec, but {table.names}")
