"""Drizzled images of the Hubble Space Telescope: HST's own products, or mosaics of a survey.

One file a band:

    *_drz.fits, *_drc.fits    HDUs SCI, WHT and CTX
    *_sci.fits                the first image, and *_wht.fits beside it (*_sci_* and *_wht_* too)
    *_flt.fits, *_flc.fits    HDUs SCI, ERR and DQ of one chip

SCI or the primary header has the WCS, BUNIT, PHOTFLAM and PHOTPLAM (AB zero point of one count a
second; with a BUNIT without "/S" counts are those of EXPTIME, the whole exposure) and FILTER, or
FILTER1 and FILTER2. An ERR is the pixels' standard deviation. A WHT may be exposure time or
inverse variance, in any scale: it is used as proportional to the inverse variance, with the
factor for which the blank sky in the mosaic's middle has unit scatter. Drizzling
correlates the noise of neighbouring pixels: its correlation is estimated unless noise = "white".
DQ: any bit means ignore, unless mask_bits are given.

Source: the DrizzlePac Handbook, and the ACS and WFC3 data handbooks (STScI).
"""

from __future__ import annotations

import numpy as np

from ...files.atomic import FileError
from ...files.fits import open_fits
from ...sky.noise import noise_sigma
from ..field_toml.estimates import sample_box
from ..field_toml.headers import mask_value, zero_point
from ..mosaic import Channel, Mosaic
from .band_files import (
    BandFiles,
    ReaderOptions,
    assemble_mosaic,
    image_plane,
    matching_plane,
    paths_of,
    require_grid,
)
from .planes import ScaledPlane

CLEAR = "CLEAR", "N/A", "NONE", ""  # values of filter wheels without a filter


def read_hst(path, **given) -> Mosaic:
    """The Mosaic of drizzled images of HST.

    path: one file, or a list with one for each band on the same pixels
    given: see `ReaderOptions`; bands are named by the filters, such as "F814W". The files hold no
        PSF

    Raises ValueError, one line, for what is missing; FileError for what cannot be read.
    """
    known = ReaderOptions(**given)
    found = [_band(file, known) for file in paths_of(path)]
    drizzled = all(one.kind == "weight" for one in found)
    return assemble_mosaic("HST", found, known, noise="estimate" if drizzled else "white")


def _band(path, given):
    """Locates the planes in the file of one band."""
    with open_fits(path) as hdus:
        names = [hdu.name for hdu in hdus]
    data, _, header, grid = image_plane(path, "SCI" if "SCI" in names else None)
    grid = require_grid(path, grid)
    band, files, mask, value = _filter(header, path), {"image": path}, None, None
    if "ERR" in names:
        weight, kind = matching_plane(grid, path, "ERR")[0], "rms"
    else:
        weight, kind = _weight(path, names, data, grid, band, files, given), "weight"
    if "DQ" in names:
        mask, flags = matching_plane(grid, path, "DQ")
        value = None if given.mask_bits is None else mask_value(flags, given.mask_bits)
    return BandFiles(
        band,
        grid,
        data,
        weight,
        kind,
        mask,
        value,
        zero_point(header, grid.pixel_scale_arcsec),
        missing_zero_point="the header has no PHOTFLAM and PHOTPLAM (and EXPTIME for total counts)",
        missing_psf="files of HST hold none",
        files=files,
    )


def _weight(path, names, data, grid, band, files, given):
    """The plane of WHT, scaled to inverse variances."""
    if "WHT" in names:
        plane, _ = matching_plane(grid, path, "WHT")
    else:
        beside = path.with_name("wht".join(path.name.rsplit("sci", 1)))
        if "sci" not in path.name or not beside.exists():
            raise ValueError(
                f"weight of band {band} is missing: {path.name} has no HDU ERR or WHT, and no file "
                "of weights (wht for sci in its name) lies beside it; without format, image and "
                "rms name any files"
            )
        plane, _ = matching_plane(grid, beside)
        files["weight"] = beside
    box = sample_box(grid)
    pixels = Channel(band, data, plane)
    weights = pixels.weights(box)
    try:
        sigma = noise_sigma(pixels.read(box) * np.sqrt(weights), weights == 0)
    except ValueError as error:
        raise FileError(f"{path}: scale of WHT: {error}") from error
    given.notes.append(
        f"{band}: WHT times {sigma**-2:.4g} taken as inverse variance, by the scatter of blank sky"
    )
    return ScaledPlane(plane, sigma**-2)


def _filter(header, path):
    """The filter's name: FILTER, or the one of FILTER1 and FILTER2 that is not clear."""
    for key in ("FILTER", "FILTER1", "FILTER2", "FILTNAM1"):
        name = str(header.get(key, "")).strip()
        if name.upper() not in CLEAR and not name.upper().startswith("CLEAR"):
            return name
    return path.name.split(".")[0]
