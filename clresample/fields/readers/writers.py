"""Simulated mosaics in surveys' formats: a tile of Euclid's MER, a cell coadd of Rubin.

They hold what euclid_mer.py and rubin_coadd.py read, and nothing else of such files.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from ...files.fits import write_hdus
from ..field_toml.headers import NANOJANSKY

LOSSLESS = {"compression_type": "GZIP_2", "quantize_level": 0}
SHEET_STAMPS = 16  # stamps side by side on the sheet of a CATALOG-PSF


def write_mer_tile(folder, tile, band, data, grid, *, rms, flags, zero_point, psfs, places):
    """Writes one band of a tile of Euclid's MER; returns the four paths, the image first.

    folder: that exists; tile: its number; band: such as "VIS"
    data, rms (Ny, Nx) [counts]; flags (Ny, Nx): whole numbers; zero_point [mag]: AB of one count
    psfs (K, n, n) [1], places (K, 2) [px]: the PSF at (y, x), as ScatteredPSF has it; n is odd
    """
    folder, header = Path(folder), grid.to_wcs().to_header(relax=True)
    header["MAGZERO"] = (zero_point, "AB zero point")
    header["FILTER"] = band
    paths = [
        folder / f"EUC_MER_{kind}_TILE{tile}-SIM.fits"
        for kind in (
            f"BGSUB-MOSAIC-{band}",
            f"MOSAIC-{band}-RMS",
            f"MOSAIC-{band}-FLAG",
            f"CATALOG-PSF-{band}",
        )
    ]
    for path, pixels in zip(paths, (data, rms, flags), strict=False):
        write_hdus(path, [fits.PrimaryHDU(np.asarray(pixels), header)])
    write_hdus(paths[3], _mer_sheet(grid, np.asarray(psfs, np.float32), np.asarray(places)))
    return paths


def _mer_sheet(grid, psfs, places):
    """The HDUs of a CATALOG-PSF."""
    size, n = psfs.shape[1], len(psfs)
    rows = -(-n // SHEET_STAMPS)
    sheet = np.zeros((rows * size, SHEET_STAMPS * size), np.float32)
    corner = np.stack(np.divmod(np.arange(n), SHEET_STAMPS), axis=1) * size
    for (y, x), stamp in zip(corner, psfs, strict=True):
        sheet[y : y + size, x : x + size] = stamp
    ra, dec = grid.sky(*places.T)
    middle = corner + size // 2 + 1  # counted from 1
    columns = {"x": places[:, 1] + 1, "y": places[:, 0] + 1, "Ra": ra, "Dec": dec}
    columns |= {"x_center": middle[:, 1].astype(float), "y_center": middle[:, 0].astype(float)}
    image = fits.ImageHDU(sheet)
    image.header["STMPSIZE"] = (size, "pixels a side of a stamp")
    return [fits.PrimaryHDU(), image, fits.table_to_hdu(Table(columns))]


def write_cell_coadd(
    path, band, data, grid, *, variance, mask, zero_point, psf_at, cell_px, noises=()
):
    """Writes a cell coadd of Rubin; returns the path.

    data [counts], variance [counts^2] (Ny, Nx): they are written in nJy
    mask {name: (Ny, Nx) bool}: planes; zero_point [mag]: AB of one count
    psf_at: called with (y, x), the middle of each cell, returns images (ny, nx) of one shape, NaN
        for a cell that is missing; cell_px: side of a cell
    noises: images (Ny, Nx) [counts] of the noise alone
    """
    unit = 10 ** (0.4 * (NANOJANSKY - zero_point))
    header = grid.to_wcs().to_header(relax=True)
    flags = np.zeros(grid.shape, np.int32)
    names = fits.Header()
    for bit, (name, where) in enumerate(mask.items()):
        flags |= np.asarray(where, np.int32) << bit
        names[f"MSKN{bit:04d}"], names[f"MSKM{bit:04d}"] = name, 1 << bit
    n_y, n_x = (-(-n // cell_px) for n in grid.shape)
    middle = (np.arange(max(n_y, n_x)) + 0.5) * cell_px - 0.5
    psfs = np.array([[psf_at(y, x) for x in middle[:n_x]] for y in middle[:n_y]])
    tile = {"tile_shape": (cell_px, cell_px)} | LOSSLESS
    planes = [("IMAGE", unit * np.asarray(data), "nJy")]
    planes += [("VARIANCE", unit**2 * np.asarray(variance), "nJy2")]
    planes += [(f"NOISE_REALIZATIONS/{k}", unit * image, "nJy") for k, image in enumerate(noises)]
    hdus = []
    for name, pixels, bunit in planes:
        hdus.append(fits.CompImageHDU(pixels.astype(np.float32), header, name=name, **tile))
        hdus[-1].header["BUNIT"] = bunit
    hdus.insert(1, fits.CompImageHDU(flags, header + names, name="MASK", **tile))
    hdus += [fits.ImageHDU(psfs, name="PSF"), _tree(band, grid.shape, (n_y, n_x), cell_px)]
    write_hdus(path, [fits.PrimaryHDU(), *hdus])
    return path


def _tree(band, shape, cells, cell_px):
    """The HDU of the tree, with the positions of the PSF's cells alone."""
    whole = {axis: {"start": 0, "stop": n * cell_px} for axis, n in zip("yx", cells, strict=True)}
    bounds = {
        "grid": {"bbox": whole, "cell_shape": {"y": cell_px, "x": cell_px}},
        "bbox": whole,
        "missing": [],
    }
    tree = {
        "schema_version": "1.0.0",
        "min_read_version": 1,
        "band": band,
        "image": {"yx0": [0, 0], "data": {"value": {"source": "fits:IMAGE", "shape": list(shape)}}},
        "psf": {"min_read_version": 1, "array": {"source": "fits:PSF"}, "bounds": bounds},
    }
    text = np.frombuffer(json.dumps(tree).encode(), np.uint8)
    rows = np.empty(1, object)
    rows[0] = text
    return fits.BinTableHDU.from_columns([fits.Column("JSON", "PB()", array=rows)], name="JSON")
