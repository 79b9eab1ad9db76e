"""Cell coadds of Rubin, as the package lsst-images writes them from DP2 on.

One FITS file a band and patch, with tile-compressed HDUs and a tree of metadata:

    IMAGE                    nJy, with the WCS of the tract (gnomonic)
    MASK                     bits, named by cards MSKNnnnn with their value in MSKMnnnn; a second
                             HDU of the name (EXTVER 2) where there are over 31 planes
    VARIANCE                 nJy^2
    NOISE_REALIZATIONS/n     images of the noise alone
    PSF                      (cells_y, cells_x, ny, nx): one image a cell, NaN where one is missing
    JSON                     a table with one row, one column JSON: the tree as UTF-8. Read are
                             `band`, `image.yx0`, the number of the first pixel in the tract, and of
                             `psf.bounds` the first pixel of the cells and `grid.cell_shape`

The correlation of the noise is that of its realisations, where there are some. Pixels of NO_DATA,
SATURATED and their like are ignored (UNUSABLE), unless mask_bits are given. The pixels and the tree
are plain FITS, so that no package of Rubin's is needed to read them.

Source: https://images.lsst.io, schemas cell_coadd, cell_psf and mask, version 1.
"""

from __future__ import annotations

import json

import numpy as np

from ...files.atomic import FileError
from ...files.fits import open_fits, read_pixels
from ...sky.correlation import NoiseCorrelation
from ..field_toml.estimates import sample_box
from ..field_toml.headers import saturation, zero_point
from ..mosaic import Channel, FilePlane, Mosaic
from ..psfs.sampled import CellPSF
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

READS = 1  # version of the schemas; a file that requires a higher one raises FileError
NOISE = "NOISE_REALIZATIONS/"


def read_rubin_coadd(path, **given) -> Mosaic:
    """The Mosaic of cell coadds of one patch.

    path: one file, or a list with one for each band
    given: see `ReaderOptions`; bands are those of the files, such as "r"

    Raises ValueError, one line, for what is missing; FileError for what is no cell coadd.
    """
    known = ReaderOptions(**given)
    return assemble_mosaic("Rubin", [_band(file, known) for file in paths_of(path)], known)


def _band(path, given):
    """Locates the planes in the file of one band."""
    with open_fits(path) as hdus:
        tree = _tree(path, hdus)
        images = read_pixels(path, hdus["PSF"])
        noises = [i for i, hdu in enumerate(hdus) if hdu.name.startswith(NOISE)]
    data, _, header, grid = image_plane(path, "IMAGE")
    grid = require_grid(path, grid)
    variance, _ = matching_plane(grid, path, "VARIANCE")
    try:
        bounds, first = tree["psf"]["bounds"], tree["image"]["yx0"]
        cell = [bounds["grid"]["cell_shape"][axis] for axis in "yx"]
        start = [bounds["bbox"][axis]["start"] for axis in "yx"]
    except (KeyError, TypeError) as error:
        raise FileError(f"{path}: its tree does not say where the PSF's cells lie") from error
    origin = np.array(start, float) - first - 0.5
    band = tree.get("band") or path.name.split(".")[0]
    mask = rubin_mask(path, grid, given.mask_bits, band, given.notes)
    return BandFiles(
        band,
        grid,
        data,
        variance,
        "variance",
        mask,
        None,
        zero_point(header, grid.pixel_scale_arcsec),
        CellPSF(images, cell_px=cell, origin_px=origin),
        noise=_noise(path, noises, grid, data, variance, mask, given),
        missing_zero_point=f"BUNIT is {header.get('BUNIT')!r}",
        saturation=saturation(header),
        files={"image": path},
    )


def _tree(path, hdus):
    """The tree of metadata. Raises FileError for a file without one, or of a later schema."""
    if not {"IMAGE", "VARIANCE", "PSF", "JSON"} <= {hdu.name for hdu in hdus}:
        there = ", ".join(hdu.name for hdu in hdus if hdu.name)
        raise FileError(
            f"{path}: no cell coadd, which has IMAGE, VARIANCE, PSF and JSON (HDUs: {there})"
        )
    tree = json.loads(np.asarray(hdus["JSON"].data["JSON"][0]).astype(np.uint8).tobytes())
    for part in (tree, tree.get("psf", {})):
        if part.get("min_read_version", READS) > READS:
            raise FileError(
                f"{path}: needs a reader of version {part['min_read_version']}, this is {READS}"
            )
    return tree


def _noise(path, numbers, grid, data, variance, mask, given):
    """The correlation of the noise by its realisations in the middle, None without any."""
    if not numbers or given.noise is not None:
        return None
    box = sample_box(grid)
    weights = Channel("noise", data, variance, "variance", mask).weights(box)
    images = np.stack([FilePlane(path, number).read(box) for number in numbers])
    good = np.isfinite(images).all(axis=0)
    try:
        return NoiseCorrelation.from_realisations(
            np.where(good, images, 0), weights=np.where(good, weights, 0)
        )
    except ValueError as error:
        raise FileError(f"{path}: noise realisations: {error}") from error
