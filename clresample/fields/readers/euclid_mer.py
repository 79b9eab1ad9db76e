"""Reads tiles of Euclid's MER: mosaics of VIS, NIR and ground bands, on 0.1 arcsec pixels.

A folder holds, for each band (VIS, NIR-Y, NIR-J, NIR-H, DECAM-g, ...) of a tile, as FITS files of
which the first image is read, compressed (.gz) or not:

    EUC_MER_BGSUB-MOSAIC-<band>_TILE<tile>-*.fits   the image, background subtracted; its header has
                                                    the WCS and MAGZERO, the AB zero point
    EUC_MER_MOSAIC-<band>-RMS_TILE<tile>-*.fits     standard deviation of each pixel
    EUC_MER_MOSAIC-<band>-FLAG_TILE<tile>-*.fits    bits; any means: ignore, unless mask_bits are
                                                    given
    EUC_MER_CATALOG-PSF-<band>_TILE<tile>-*.fits    stamps of the PSF, see `read_mer_sheet`

All bands of a tile have the same pixels and make one mosaic. MER resamples frames, which correlates
the noise of neighbouring pixels: its correlation is estimated unless noise = "white".

Source: the Euclid data product description of MER (https://euclid.esac.esa.int/dr/q1/dpdd).
"""

from __future__ import annotations

import re

from ...files.atomic import FileError
from ..field_toml.headers import mask_value, saturation, zero_point
from ..mosaic import Mosaic
from ..psfs.read import read_psf_field
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

NAME = re.compile(
    r"EUC_MER_(BGSUB-MOSAIC|MOSAIC|CATALOG-PSF)-(.+?)(-RMS|-FLAG)?_TILE(\d+)([-_].*)?\.fits(\.gz)?"
)
IMAGE, RMS, FLAG, PSF = "BGSUB-MOSAIC", "MOSAIC-RMS", "MOSAIC-FLAG", "CATALOG-PSF"


def read_euclid_mer(path, **given) -> Mosaic:
    """The Mosaic of a tile of Euclid's MER.

    path: a folder with one tile, or BGSUB-MOSAIC files whose RMS, FLAG and PSF lie beside them
    given: see `ReaderOptions`; bands are those of the files' names, such as "VIS" and "NIR-H"

    Raises ValueError, one line, for what is missing; FileError for what cannot be read.
    """
    known = ReaderOptions(**given)
    found = [_band(band, files, known) for band, files in _bands(paths_of(path), known).items()]
    return assemble_mosaic("Euclid", found, known, noise="estimate")


def _bands(paths, given):
    """{band: {kind: path}} of the tile."""
    there = files_at(paths)
    wanted = None if len(paths) == 1 and paths[0].is_dir() else set(paths)
    files: dict[str, dict] = {}
    tiles = set()
    for file in there:
        match = NAME.fullmatch(file.name)
        if match is None:
            continue
        kind, band, tile = match[1] + (match[3] or ""), match[2], match[4]
        if kind == IMAGE and (wanted is None or file in wanted):
            tiles.add(tile)
        kinds = files.setdefault((tile, band), {})
        if kind in kinds:
            raise FileError(f"{file}: and {kinds[kind].name} are both the {kind} of {band}")
        kinds[kind] = file
    if not tiles:
        raise FileError(f"{paths[0]}: no EUC_MER_BGSUB-MOSAIC-<band>_TILE<tile>*.fits")
    if len(tiles) > 1:
        raise FileError(
            f"{paths[0]}: holds tiles {', '.join(sorted(tiles))}: give the files of one"
        )
    bands = {
        band: kinds
        for (tile, band), kinds in files.items()
        if tile in tiles and IMAGE in kinds and (wanted is None or kinds[IMAGE] in wanted)
    }
    if given.bands is None:
        return bands
    asked = [given.bands] if isinstance(given.bands, str) else given.bands
    return {band: kinds for band, kinds in bands.items() if band in asked} or bands


def _band(band, files, given):
    """Locates the files of one band."""
    path = files[IMAGE]
    if RMS not in files:
        raise ValueError(f"rms of band {band} is missing: no EUC_MER_MOSAIC-{band}-RMS beside it")
    data, _, header, grid = image_plane(path)
    grid = require_grid(path, grid)
    rms, _ = matching_plane(grid, files[RMS])
    mask = value = None
    if FLAG in files:
        mask, flags = matching_plane(grid, files[FLAG])
        value = None if given.mask_bits is None else mask_value(flags, given.mask_bits)
    else:
        given.notes.append(f"{band}: no EUC_MER_MOSAIC-{band}-FLAG: no pixel is masked")
    psf = None
    if PSF in files and given.psf is None:
        psf = read_psf_field(files[PSF], "euclid-mer", grid)
    return BandFiles(
        band,
        grid,
        data,
        rms,
        "rms",
        mask,
        value,
        zero_point(header, grid.pixel_scale_arcsec),
        psf,
        missing_psf=f"there is no EUC_MER_CATALOG-PSF-{band} beside it",
        saturation=saturation(header),
        files=files,
    )
