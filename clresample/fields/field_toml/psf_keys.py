"""The keys of an image's PSF: its files, their form, and the image's place in the PSF's pixels."""

from __future__ import annotations

import warnings

import numpy as np

from ...files.atomic import FileError
from ...files.fits import band_names, choose_hdu, open_fits
from ...sky.psf_checks import PSFWarning, check_edge
from ..psfs.combined import ConstantPSF, PerBandPSF
from ..psfs.psfex import PSFExPSF
from ..psfs.read import read_psf_field

# Remedy for a PSF whose core lies off its array's centre.
CORE = 'psf_center = "core"'
# [px] Offsets up to this are not reported: PSFs of detectors change by less than 1e-3 of their norm
# within it. Headers of images whose first row was trimmed have LTV = -1.
SMALL_PX = 2.0
# [1] of PSFEx's scaled positions, at whose -0.5 and 0.5 its outermost stars lie.
STARS_REACH = 0.6


def read_psf_keys(folder, table, grid, header, bands, inputs, notes):
    """The PSFField of a table's keys, adding its files to `inputs`.

    folder, inputs, notes: as in `read_mosaic`; grid: of the image; header: of the image, or None
    bands: Bands of the image, or None where they are not known yet
    Raises FileError and ValueError, of one line.
    """
    form, name = table.get("psf_format", "image"), table["name"]
    given = _given(table, form)
    files = table["psf"] if isinstance(table["psf"], list) else [table["psf"]]
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)  # reported in the notes
        for k, one in enumerate(files):
            number = f" {k + 1}" if len(files) > 1 else ""
            inputs[f"PSF{number} of {name}"] = folder / one
            found.append(read_psf_field(folder / one, form, grid, **given))
            if form == "image":
                _check(folder / one, found[-1].psf)
    psf = found[0] if len(found) == 1 else PerBandPSF(found)
    if bands is not None:
        names = []
        if len(files) > 1:
            bands.check_list("psf")
        elif form == "image":
            names = _band_names(folder / files[0], given["hdu"])
        psf = _of_bands(psf, table, bands, names)
    if not psf.varies:
        return psf
    origin = _origin(table, form, header, grid, found[0], notes)
    if isinstance(found[0], PSFExPSF):
        _check_stars(found[0], origin, grid, name, notes)
    return psf if not origin.any() else psf.cutout(*origin)


def _given(table, form):
    """Arguments of `read_psf_field` by the table's keys."""
    center = table.get("psf_center", "middle")
    given = {
        "hdu": table.get("psf_hdu"),
        "bands": table.get("psf_bands"),
        "spacing": table.get("psf_spacing", 1.0),
        "center": None if center == "middle" else center,
    }
    for key in ("stamp_px", "detector"):
        if f"psf_{key}" in table:
            given[key] = table[f"psf_{key}"]
    if form == "cells":
        if "psf_cell_px" not in table:
            raise ValueError('psf_cell_px is missing: psf_format = "cells" needs a cell\'s size')
        given["cell_px"] = table["psf_cell_px"]
        if "psf_origin_px" in table:
            given["origin_px"] = table["psf_origin_px"]
    return given


def _band_names(path, hdu):
    """Names of the planes of a PSF's image or cube."""
    with open_fits(path) as hdus:
        chosen = choose_hdu(path, hdus, hdu)
        return band_names(chosen.header, chosen.shape[0] if len(chosen.shape) == 3 else 1)


def _check(path, psf):
    try:
        check_edge(psf.images)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error


def _of_bands(psf, table, bands, names):
    """The PSF of the bands that are taken. Raises ValueError where their numbers disagree.

    names: of the planes of a cube
    """
    n = len(bands.chosen)
    all_bands = psf.n_bands == bands.n_all and n != bands.n_all
    if isinstance(psf, ConstantPSF) and "psf_bands" not in table:
        own = bands.in_cube(names)
        if own is not None or psf.n_bands == bands.n_all:
            return ConstantPSF(psf.psf.select(bands.chosen if own is None else own))
    if psf.n_bands not in (1, n) or all_bands:
        raise ValueError(
            f"psf has {psf.n_bands} bands, the image {n}: choose with bands and psf_bands"
        )
    return psf


def _origin(table, form, header, grid, psf, notes) -> np.ndarray:
    """(y, x) [px, from 0] of the image's first pixel in the image that the PSF was made for.

    By psf_cutout_px; by psf_crpix, the CRPIX of that image; of PSFEx and Piff by LTV1 and LTV2, the
    offsets that IRAF, ds9 and the archives write into cutouts; else 0.
    """
    if "psf_cutout_px" in table and "psf_crpix" in table:
        raise ValueError("psf_cutout_px and psf_crpix are both given: give one")
    if "psf_cutout_px" in table:
        return np.array(table["psf_cutout_px"], float)
    if "psf_crpix" in table:
        cards = [None if header is None else header.get(f"CRPIX{i}") for i in (1, 2)]
        if None in cards:
            raise ValueError("psf_crpix is given, the image's header has no CRPIX1 and CRPIX2")
        return (np.array(table["psf_crpix"], float) - np.array(cards, float))[::-1]
    if header is None or form not in ("psfex", "piff"):
        return np.zeros(2)
    offset = -np.array([_number(header.get(f"LTV{i}", 0)) for i in (2, 1)])
    scales = [_number(header.get(f"LTM{i}_{i}", 1)) for i in (1, 2)]
    if scales != [1, 1] or np.abs(offset).max() < SMALL_PX:
        return np.zeros(2)
    middle = (np.array(grid.shape) - 1) / 2
    if isinstance(psf, PSFExPSF) and _among_stars(psf, middle) > _among_stars(psf, middle + offset):
        return np.zeros(2)
    notes.append(
        f"{table['name']}: image begins at (y, x) = ({offset[0]:g}, {offset[1]:g}) [px] of the "
        "PSF's detector, by LTV1 and LTV2: give psf_cutout_px if not"
    )
    return offset


def _check_stars(psf, origin, grid, name, notes):
    """Adds a note where an image lies away from the stars of a PSFEx file."""
    middle = (np.array(grid.shape) - 1) / 2
    if psf.degree and not _among_stars(psf, middle + origin):
        notes.append(
            f"{name}: the image's middle lies outside the stars of the PSFEx file, about (y, x) = "
            f"({psf.zero[1]:.0f}, {psf.zero[0]:.0f}) [px]: if the image is a cutout, give "
            "psf_cutout_px or psf_crpix"
        )


def _among_stars(psf, position):
    return bool((np.abs(psf.scaled(*position)) <= STARS_REACH).all())


def _number(value):
    return float(value) if isinstance(value, int | float) else 0.0
