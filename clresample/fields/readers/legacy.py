"""Bricks of the DESI Legacy Imaging Surveys: coadds of g, r, i, z on 0.262 arcsec pixels.

A folder (`coadd/<AAA>/<brick>` of a data release) holds, for each band, as compressed FITS files of
which the first image is read:

    legacysurvey-<brick>-image-<band>.fits.fz     nanomaggies, sky subtracted, WCS in the header
    legacysurvey-<brick>-invvar-<band>.fits.fz    inverse variances
    legacysurvey-<brick>-maskbits.fits.fz         bits, for all bands: see BITS
    legacysurvey-<brick>-copsf-<band>.fits.fz     the coadd's PSF, of runs that wrote it
    legacysurvey-<brick>-psfsize-<band>.fits.fz   the PSF's width at each pixel: FWHM in arcsec

Pixels of which every exposure of the band is masked (ALLMASK) or one is saturated (SATUR) are
ignored, unless mask_bits are given. Without copsf the PSF is a Moffat profile with the widths of
psfsize, which varies over the brick, with a note: pass psf for a measured one.

Source: https://www.legacysurvey.org/dr10/files/ and /dr10/bitmasks/.
"""

from __future__ import annotations

import re

import numpy as np

from ...files.atomic import FileError
from ...files.fits import choose_hdu, open_fits, read_pixels
from ...sky.box import Box
from ...sky.psf import PSF
from ..field_toml.headers import NANOMAGGY, mask_value
from ..mosaic import Mosaic
from ..psfs.combined import ConstantPSF
from ..psfs.sampled import ScatteredPSF
from .band_files import (
    BandFiles,
    ReaderOptions,
    assemble_mosaic,
    files_at,
    image_plane,
    matching_plane,
    paths_of,
    require_grid,
)

NAME = re.compile(r"legacysurvey-(\w+)-(image|invvar|copsf|psfsize|maskbits)(?:-(\w+))?\.fits.*")
BITS = (  # of maskbits, by their numbers
    *("NPRIMARY", "BRIGHT", "SATUR_G", "SATUR_R", "SATUR_Z", "ALLMASK_G", "ALLMASK_R", "ALLMASK_Z"),
    *("WISEM1", "WISEM2", "BAILOUT", "MEDIUM", "GALAXY", "CLUSTER"),
    *("SATUR_I", "ALLMASK_I", "SUB_BLOB"),
)
# Exponent of the Moffat profile: that of stars at good sites (Racine 1996, PASP 108, 699). A
# smaller one has more light in the wings and gives larger fluxes.
MOFFAT_BETA = 3.0
N_PLACES = 5  # along each axis at which the PSF is made: widths change over thousands of pixels
# [FWHM] half side of its stamps: beyond it lies 0.2 % of the light of such a profile
REACH_FWHM = 5.0


def read_legacy_survey(path, **given) -> Mosaic:
    """The Mosaic of a brick of the Legacy Surveys.

    path: a folder with one brick, or its image files, with the others beside them
    given: see `ReaderOptions`; bands are "g", "r", "i", "z"

    Raises ValueError, one line, for what is missing; FileError for what cannot be read.
    """
    known = ReaderOptions(**given)
    files = _files(paths_of(path))
    bands = sorted(band for kind, band in files if kind == "image")
    return assemble_mosaic("Legacy Surveys", [_band(b, files, known) for b in bands], known)


def _files(paths):
    """{(kind, band): path} of the brick; the band of maskbits is None."""
    folder = len(paths) == 1 and paths[0].is_dir()
    files, bricks = {}, set()
    for file in files_at(paths):
        match = NAME.fullmatch(file.name)
        if match and (folder or match[2] != "image" or file in paths):
            files[match[2], match[3]] = file
            if match[2] == "image":
                bricks.add(match[1])
    if not bricks:
        raise FileError(f"{paths[0]}: no legacysurvey-<brick>-image-<band>.fits.fz")
    if len(bricks) > 1:
        raise FileError(f"{paths[0]}: holds bricks {', '.join(sorted(bricks))}: give one's images")
    (brick,) = bricks
    return {key: f for key, f in files.items() if NAME.fullmatch(f.name)[1] == brick}


def _band(band, files, given):
    """Locates the files of one band."""
    path = files["image", band]
    data, _, _, grid = image_plane(path)
    grid = require_grid(path, grid)
    if ("invvar", band) not in files:
        raise ValueError(f"weight of band {band} is missing: no invvar-{band} beside {path.name}")
    weight, _ = matching_plane(grid, files["invvar", band])
    mask = value = None
    if ("maskbits", None) in files:
        mask, header = matching_plane(grid, files["maskbits", None])
        own = [n for n in (f"SATUR_{band.upper()}", f"ALLMASK_{band.upper()}") if n in BITS]
        bits = own if given.mask_bits is None else given.mask_bits
        value = mask_value(header, bits, {name: i for i, name in enumerate(BITS)})
    else:
        given.notes.append(f"{band}: no maskbits beside {path.name}: no pixel is masked")
    psf = None if given.psf is not None else _psf(band, files, grid, given)
    used = {k: f for (k, b), f in files.items() if b in (band, None)}
    return BandFiles(
        band,
        grid,
        data,
        weight,
        "weight",
        mask,
        value,
        NANOMAGGY,
        psf,
        missing_psf=f"there is neither copsf-{band} nor psfsize-{band} beside it",
        files=used,
    )


def _psf(band, files, grid, given):
    """The coadd's own PSF, else that of the map of widths, else None."""
    if ("copsf", band) in files:
        with open_fits(files["copsf", band]) as hdus:
            path = files["copsf", band]
            return ConstantPSF(PSF(read_pixels(path, choose_hdu(path, hdus, None))))
    if ("psfsize", band) not in files:
        return None
    widths, _ = matching_plane(grid, files["psfsize", band])
    places = np.array(
        [
            (y, x)
            for y in np.linspace(0, grid.shape[0] - 1, N_PLACES)
            for x in np.linspace(0, grid.shape[1] - 1, N_PLACES)
        ]
    )
    at = [widths.read(Box(int(y), int(x), int(y) + 1, int(x) + 1))[0, 0] for y, x in places]
    fwhm = np.array(at, float) / grid.pixel_scale_arcsec
    good = np.isfinite(fwhm) & (fwhm > 0)
    if not good.any():
        raise FileError(f"{files['psfsize', band]}: holds no width above 0")
    middle = float(np.median(fwhm[good])) * grid.pixel_scale_arcsec
    given.notes.append(
        f"{band}: PSF taken as Moffat profiles (beta {MOFFAT_BETA:g}) with the widths of psfsize, "
        f"FWHM {middle:.2f} arcsec; give psf for a measured one"
    )
    half = int(np.ceil(REACH_FWHM * fwhm[good].max()))
    return ScatteredPSF(np.stack([_moffat(w, half) for w in fwhm[good]]), places[good])


def _moffat(fwhm, half):
    """A Moffat profile (2 half + 1, 2 half + 1) of this FWHM [px], as seen by the pixels."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    scale = fwhm / (2 * np.sqrt(2 ** (1 / MOFFAT_BETA) - 1))
    return (1 + (y**2 + x**2) / scale**2) ** -MOFFAT_BETA
