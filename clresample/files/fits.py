"""FITS images, cubes and PSFs in; resampled images with WCS, coverage and provenance out."""

from __future__ import annotations

import re
import warnings
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from astropy.wcs import WCS

from .. import __version__
from ..sky.grid import Grid
from ..sky.psf import PSF
from .atomic import FileError, atomic_file, check_output
from .fits_names import text_card
from .headers import check_headers
from .tile_sizes import check_tiles

# header cards that describe a third axis
THIRD_AXIS = re.compile(r"(NAXIS|CTYPE|CUNIT|CRPIX|CRVAL|CDELT|CROTA)3|(PC|CD)(3_\d|\d_3)")


class FitsImage(NamedTuple):
    """Return value of `read_image`.

    data (C, Ny, Nx) [the file's unit]: native float32 or float64; grid: Grid of (Ny, Nx)
    header: the image's FITS header; bands: names of the C bands, their numbers where the header
        has none
    """

    data: np.ndarray
    grid: Grid
    header: fits.Header
    bands: tuple

    @property
    def n_invalid(self):
        """Number of NaN and infinite pixels."""
        return int(np.count_nonzero(~np.isfinite(self.data)))


def read_image(path, *, hdu=None, bands=None):
    """Reads an image or cube of a FITS file: FitsImage(data, grid, header, bands).

    path: of the FITS file
    hdu: number (from 0), "NAME" or "NAME,VERSION"; None = the first that holds an image
    bands: numbers (from 0) or names, one or several; None = all. Names are those of the cards
        BAND1, BAND2, ..., and of a 2-D image BAND or FILTER

    Raises FileError (a ValueError, one line that names the file) for a file, HDU or band that does
    not exist, and for one that is not FITS, damaged, not an image, or without a celestial WCS.
    """
    with open_fits(path) as hdus:
        chosen = choose_hdu(path, hdus, hdu)
        data, header = read_pixels(path, chosen), chosen.header.copy()
        wcs = celestial_header(path, header, hdus)
        if not wcs.has_celestial:
            raise FileError(f"{path}: HDU {_label(hdus, chosen)} has no celestial WCS")
        # array axes count in the opposite order to FITS axes; the band axis is not on the sky
        rest = sorted({0, 1, 2} - {wcs.wcs.lng, wcs.wcs.lat})
        if len(rest) != 1 or (data.ndim == 2 and rest != [2]):
            raise FileError(f"{path}: the celestial axes of its WCS are not axes of the image")
        data = data[None] if data.ndim == 2 else np.moveaxis(data, 2 - rest[0], 0)
        try:
            grid = Grid.from_wcs(wcs, data.shape)
        except ValueError as error:
            raise FileError(f"{path}: {error}") from error
    names = band_names(header, len(data))
    chosen = choose_bands(path, names, bands)
    return FitsImage(to_native(data[chosen]), grid, header, tuple(names[i] for i in chosen))


def read_psf(path, *, hdu=None, bands=None, spacing=1.0, center=None):
    """Reads the PSF of a FITS image or cube; no WCS is needed.

    path: of the FITS file; hdu, bands: as in `read_image`
    spacing [px], center [samples]: as in `PSF`

    Raises FileError as `read_image` does, and for samples that `PSF` rejects. Warns as `PSF` does.
    """
    with open_fits(path) as hdus:
        chosen = choose_hdu(path, hdus, hdu)
        data, header = read_pixels(path, chosen), chosen.header
        data = data[None] if data.ndim == 2 else data
        chosen = choose_bands(path, band_names(header, len(data)), bands)
    try:
        return PSF(to_native(data[chosen]), spacing=spacing, center=center)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error


def write_fits(
    path,
    data,
    grid,
    *,
    bands=None,
    coverage=None,
    unit=None,
    device=None,
    inputs=None,
    shift_px=None,
    overwrite=False,
):
    """Writes an image or cube with its WCS, coverage and provenance, whole or not at all.

    data (Ny, Nx) or (C, Ny, Nx) [flux per pixel]
    grid: Grid of the same (Ny, Nx); a flat one is put at RA = Dec = 0
    bands: names of the C bands, into the cards BAND1, BAND2, ...
    coverage (Ny, Nx) or (C, Ny, Nx) bool: pixels that the input covers, into an HDU COVERAGE
    unit: BUNIT of the data, flux per pixel
    device: name of the OpenCL device; inputs: {what: file}
    shift_px (2,) [input px]: (y, x) shift applied
    overwrite: replace a file that exists

    Raises FileError when it exists or cannot be written, ValueError for shapes that disagree.
    """
    path, data = Path(path), np.asarray(data)
    check_output(path, overwrite=overwrite)
    if data.ndim not in (2, 3) or data.shape[-2:] != grid.shape:
        raise ValueError(f"data has the shape {data.shape}, its grid {grid.shape}")
    n_bands = 1 if data.ndim == 2 else len(data)
    if bands is not None and len(bands) != n_bands:
        raise ValueError(f"bands has {len(bands)} names, data {n_bands} bands")
    placed = grid.to_wcs().to_fits(relax=True)  # a primary header, and HDUs of look-up tables
    hdus = [fits.PrimaryHDU(data, placed[0].header)]
    cards = hdus[0].header
    if unit:
        cards["BUNIT"] = text_card(unit, "flux per pixel")
    for i, name in enumerate(bands or ()):
        cards[f"BAND{i + 1}"] = text_card(name, f"plane {i + 1}")
    add_provenance(cards, data.dtype, device, inputs or {}, shift_px)
    if coverage is not None:
        coverage = np.asarray(coverage)
        if coverage.ndim not in (2, 3) or coverage.shape[-2:] != grid.shape:
            raise ValueError(f"coverage has the shape {coverage.shape}, the grid {grid.shape}")
        covered = coverage.astype(np.uint8)
        hdus.append(fits.ImageHDU(covered, placed[0].header, name="COVERAGE"))
        hdus[-1].header["COMMENT"] = "1 where the input image covers the pixel's centre, else 0"
    write_hdus(path, hdus + list(placed[1:]))


def write_hdus(path, hdus):
    """Writes HDUs with their checksums, whole or not at all. Raises FileError."""
    with atomic_file(path) as part:
        fits.HDUList(hdus).writeto(part, checksum=True, overwrite=True)


@contextmanager
def open_fits(path):
    """The HDUs of a FITS file, within a `with`; every error on reading is a FileError."""
    path = Path(path)
    if path.is_dir():
        raise FileError(f"{path}: is a directory, not a FITS file")
    if not path.exists():
        raise FileError(f"{path}: no such file")
    if not path.is_file():  # reading it might never end
        raise FileError(f"{path}: is not a regular file, but a device, a pipe or a socket")
    # astropy warns of every header that it repairs: recorded here and not shown
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", AstropyWarning)
        try:
            check_headers(path)
            with fits.open(path, memmap=False) as hdus:
                yield hdus
        except FileError:
            raise
        except Exception as error:  # a damaged file may provoke any exception in astropy
            reason = " ".join(str(error).split()) or type(error).__name__
            cut = any("truncated" in str(warning.message) for warning in caught)
            what = "truncated" if cut else "not a FITS file, or damaged"
            raise FileError(f"{path}: {what} ({reason})") from error


def _label(hdus, hdu):
    return f"{hdus.index(hdu)} {hdu.name}".strip()


def _is_image(hdu):
    return hdu.is_image and len(hdu.shape) in (2, 3) and 0 not in hdu.shape


def choose_hdu(path, hdus, hdu):
    """The HDU by number, "NAME" or "NAME,VERSION", or the first image."""
    there = ", ".join(_label(hdus, one) for one in hdus)
    if hdu is None:
        chosen = next((one for one in hdus if _is_image(one)), None)
        if chosen is None:
            raise FileError(f"{path}: no HDU holds a 2-D or 3-D image (HDUs: {there})")
        check_tiles(path, chosen)
        return chosen
    key = hdu
    if isinstance(hdu, str):
        name, _, version = (part.strip() for part in hdu.partition(","))
        key = int(name) if name.isdigit() else (name, int(version)) if version.isdigit() else name
    try:
        chosen = hdus[key]
    except (KeyError, IndexError):
        raise FileError(f"{path}: no HDU {hdu} (HDUs: {there})") from None
    if not _is_image(chosen):
        raise FileError(f"{path}: HDU {_label(hdus, chosen)} holds no 2-D or 3-D image")
    check_tiles(path, chosen)
    return chosen


def read_pixels(path, hdu):
    """The data of an image HDU. Raises FileError where some of its pixels are missing."""
    check_tiles(path, hdu)
    data = hdu.data
    if data is None or data.shape != hdu.shape:
        raise FileError(f"{path}: truncated, the pixels of HDU {hdu.name} are not all there")
    return data


def celestial_header(path, header, hdus):
    """The WCS of the first two axes if these are on the sky, else the whole one.

    astropy takes SIP and look-up tables (and with a third axis, TPV) for two axes only.
    """
    third = [key for key in header if THIRD_AXIS.fullmatch(key)]
    first = header.copy()
    for key in third:
        del first[key]
    first["NAXIS"] = first["WCSAXES"] = 2
    coupled = any(header[key] for key in third if "_" in key and key[-3:] != "3_3")
    for cards in [header] if coupled else [first, header]:
        try:
            wcs = WCS(cards, hdus)
        except Exception as error:  # wcslib has dozens of its own kinds
            problem = error
        else:
            if wcs.has_celestial or cards is header:
                return wcs
    reason = " ".join(str(problem).split())
    raise FileError(f"{path}: WCS cannot be used ({reason})") from problem


def to_native(data):
    """C-contiguous native floats: float32 where it holds every value, else float64."""
    dtype = np.result_type(data.dtype.newbyteorder("="), np.float32)
    return np.ascontiguousarray(data, dtype=dtype)


def band_names(header, n_bands):
    """Names of an image's bands by its header, their numbers where it has none."""
    keys = [f"BAND{i + 1}" for i in range(n_bands)]
    if n_bands == 1:
        keys = [next((key for key in ("BAND1", "BAND", "FILTER") if key in header), "BAND1")]
    return [str(header.get(key, i)).strip() for i, key in enumerate(keys)]


def choose_bands(path, names, bands):
    """Indices of bands selected by number or name. Raises FileError for an unknown band."""
    if bands is None:
        return list(range(len(names)))
    chosen = []
    for band in [bands] if isinstance(bands, str | int | np.integer) else bands:
        text = str(band)
        # a band of that name is taken before the band of that number
        i = names.index(text) if text in names else int(text) if text.isdigit() else -1
        if not 0 <= i < len(names):
            there = ", ".join(
                f"{i}" if name == str(i) else f"{i} = {name}" for i, name in enumerate(names)
            )
            raise FileError(f"{path}: no band {band} (bands: {there})")
        chosen.append(i)
    if not chosen:
        raise FileError(f"{path}: bands is empty, none of the {len(names)} in the file is chosen")
    return chosen


def add_provenance(header, dtype, device, inputs, shift_px):
    """Adds cards with the software, date, arithmetic, OpenCL device, shift and input files."""
    header["CREATOR"] = (f"clresample {__version__}", "software")
    header["DATE"] = (datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"), "written, UTC")
    header["CLDTYPE"] = (str(dtype), "arithmetic of the operator")
    if device is not None:
        header["CLDEVICE"] = text_card(device, "OpenCL device")
    if shift_px is not None:
        header["CLSHIFTY"] = (float(shift_px[0]), "[pixel] shift applied, input rows")
        header["CLSHIFTX"] = (float(shift_px[1]), "[pixel] shift applied, input columns")
    for i, (what, file) in enumerate(inputs.items()):
        header[f"CLFILE{i + 1}"] = text_card(Path(file).name, what)
