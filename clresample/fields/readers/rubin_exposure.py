"""Exposures of the LSST pipelines: visits and coadds of Rubin (DP1) and HSC, without their PSF.

One FITS file a band, as afw's ExposureF and MaskedImageF, or lsst.images' MaskedImage, are written:

    PRIMARY         FLUXMAG0, FILTER; AR_HDU, the number (from 1) of the archive's index, and
                    PHOTOCALIB_ID, which of its objects is the calibration
    IMAGE           BUNIT nJy, or counts; a WCS with TAN and SIP. HDU 1 where HDUs have no names
    MASK            bits, named by cards MP_* or MSKN*; HDU 2
    VARIANCE        the square of the image's unit; HDU 3
    archive         tables: an index with id, cat.archive and row0; PhotoCalib with calibrationMean,
                    nJy a count, and isConstant; FilterLabel with band

The zero point is that of BUNIT, else of PhotoCalib, else of FLUXMAG0. The PSF lies in the archive
in a form that only afw reads: give psf, such as an image from the survey's PSF service. Pixels of
NO_DATA, SAT and their like are ignored (UNUSABLE), unless mask_bits are given.

Source: afw's documentation of FITS persistence (https://pipelines.lsst.io), and images.lsst.io.
"""

from __future__ import annotations

import math

import numpy as np

from ...files.atomic import FileError
from ...files.fits import open_fits
from ..field_toml.headers import NANOJANSKY, saturation, zero_point
from ..mosaic import Mosaic
from .band_files import (
    BandFiles,
    ReaderOptions,
    assemble_mosaic,
    image_plane,
    matching_plane,
    paths_of,
    require_grid,
)
from .rubin_mask import rubin_mask


def read_rubin_exposure(path, **given) -> Mosaic:
    """The Mosaic of exposures on the same pixels.

    path: one file, or a list with one for each band
    given: see `ReaderOptions`; bands are those of the files. psf is needed: the files hold none
        that can be read without the LSST pipelines

    Raises ValueError, one line, for what is missing; FileError for what is no exposure.
    """
    known = ReaderOptions(**given)
    return assemble_mosaic("Rubin", [_band(file, known) for file in paths_of(path)], known)


def _band(path, given):
    """Locates the planes in the file of one band."""
    with open_fits(path) as hdus:
        names = [hdu.name for hdu in hdus]
        photo, constant = _calibration(hdus)
        label = _label(hdus)
    named = {"IMAGE", "VARIANCE"} <= set(names)
    if not named and len(names) < 4:
        raise FileError(
            f"{path}: no exposure, which has IMAGE, MASK and VARIANCE (HDUs: {', '.join(names)})"
        )
    data, _, header, grid = image_plane(path, "IMAGE" if named else 1)
    grid = require_grid(path, grid)
    variance, _ = matching_plane(grid, path, "VARIANCE" if named else 3)
    band = label or str(header.get("BAND", header.get("FILTER", ""))).strip()
    band = band or path.name.split(".")[0]
    own = {key: header[key] for key in ("BUNIT", "PIXAR_SR") if key in header}
    point = zero_point(own, grid.pixel_scale_arcsec)
    if point is None and photo is not None:
        point = NANOJANSKY - 2.5 * math.log10(photo)
        if not constant:
            given.notes.append(f"{band}: calibration varies over the image, its mean is taken")
    if point is None:
        point = zero_point(header, grid.pixel_scale_arcsec)
    return BandFiles(
        band,
        grid,
        data,
        variance,
        "variance",
        rubin_mask(path, grid, given.mask_bits, band, given.notes),
        None,
        point,
        missing_zero_point="there is neither BUNIT of nJy nor PhotoCalib nor FLUXMAG0",
        missing_psf="it can be read by the LSST pipelines only",
        saturation=saturation(header),
        files={"image": path},
    )


def _tables(hdus):
    """The tables of a file with their columns' names, by the number of the HDU."""
    return {
        i: set(hdu.columns.names)
        for i, hdu in enumerate(hdus)
        if getattr(hdu, "columns", None) is not None and not hdu.is_image
    }


def _calibration(hdus):
    """nJy a count of the archive, and True if it is uniform; (None, True) without it."""
    tables, header = _tables(hdus), hdus[0].header
    index = header.get("AR_HDU", 0) - 1
    if index in tables and {"id", "cat.archive", "row0"} <= tables[index]:
        rows = hdus[index].data
        for row in rows[np.asarray(rows["id"]) == header.get("PHOTOCALIB_ID", 0)]:
            number = index + int(row["cat.archive"])
            if "calibrationMean" in tables.get(number, ()):
                return _mean(hdus[number].data[int(row["row0"])])
    found = [i for i, names in tables.items() if "calibrationMean" in names]
    if len(found) == 1 and len(hdus[found[0]].data) == 1:
        return _mean(hdus[found[0]].data[0])
    return None, True


def _mean(row):
    """calibrationMean of a row, and isConstant: of its own column, or the first of its flags."""
    names = row.array.names
    mean = float(row["calibrationMean"])
    constant = row["isConstant"] if "isConstant" in names else True
    if "isConstant" not in names and "flags" in names:
        constant = np.ravel(row["flags"])[0]
    return (mean if mean > 0 else None), bool(constant)


def _label(hdus):
    """The band of the archive's only FilterLabel, or ""."""
    for i, names in _tables(hdus).items():
        if "band" in names and hdus[i].name.upper() == "FILTERLABEL" and len(hdus[i].data) == 1:
            return str(hdus[i].data["band"][0]).strip()
    return ""
