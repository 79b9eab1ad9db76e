"""One [[mosaic]] of FIELD.toml opened: its planes, zero points, masks and PSF."""

from __future__ import annotations

import warnings

import numpy as np

from ...files.fits import celestial_header, choose_hdu, open_fits
from ...files.whole_file import FileError
from ...sky.grid import Grid
from ...sky.psf_checks import PSFWarning
from ..mosaic import Channel, FilePlane, Mosaic, NumberPlane
from ..psfs.psf_field import BandPSFs
from ..psfs.read import read_psf_field
from ..readers.formats import read_survey
from ..readers.found import SAME_PX, apart_px
from .estimates import with_background, with_noise, with_weights
from .headers import mask_value, zero_point
from .keys import WEIGHTS


def read_mosaic(folder, table, inputs, notes) -> Mosaic:
    """The Mosaic of one table; adds its files to `inputs` and what to know to `notes`.

    folder: that the files' names are relative to; table: of `parse_field`
    Raises FileError and ValueError, of one line, for what cannot be used.
    """
    if "format" in table:
        return _survey(folder, table, inputs, notes)
    name = table["name"]
    files = [folder / one for one in _listed(table["image"])]
    planes, headers, grid = _images(files, table.get("hdu"), name, inputs)
    names = table.get("channels") or _names(name, headers, len(planes))
    names = [names] if isinstance(names, str) else names
    if len(names) != len(planes):
        raise ValueError(f"channels has {len(names)} names, the images {len(planes)} planes")
    points = _zero_points(table, headers, grid, notes)
    weights, kind = _weights(folder, table, planes, grid.shape, inputs)
    masks, bits = _masks(folder, table, planes, grid.shape, inputs)
    channels = [
        Channel(names[i], plane, weights[i], kind, masks[i], bits[i], points[i])
        for i, plane in enumerate(planes)
    ]
    psf = _psf(folder, table, grid, inputs)
    mosaic = Mosaic(name, grid, tuple(channels), psf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        middle = psf.psf_at(*((np.array(grid.shape) - 1) / 2))
    notes += [f"{name}: {text}" for text in middle.warnings()]
    mosaic = with_background(mosaic, table)
    mosaic = with_weights(mosaic, notes)
    return with_noise(mosaic, table, notes)


def _survey(folder, table, inputs, notes):
    """The Mosaic of a table with a survey's files."""
    keys = ("name", "bands", "channels", "mask_bits", "zero_point", "background", "noise")
    given = {key: table[key] for key in keys if key in table}
    if isinstance(given.get("channels"), str):
        given["channels"] = [given["channels"]]
    if "psf" in table:
        about = {"name": table.get("name", table["format"])} | table
        given["psf"] = lambda grid: _psf(folder, about, grid, inputs)
    paths = [folder / one for one in _listed(table["path"])]
    return read_survey(table["format"], paths, inputs=inputs, notes=notes, **given)


def _listed(value):
    return list(value) if isinstance(value, list) else [value]


def _images(files, hdu, name, inputs):
    """Planes, their headers, and the grid that all of them share."""
    planes, headers, grid = [], [], None
    for k, path in enumerate(files):
        inputs[f"image {k + 1} of {name}" if len(files) > 1 else f"image of {name}"] = path
        with open_fits(path) as hdus:
            chosen = choose_hdu(path, hdus, hdu)
            number, header, shape = hdus.index(chosen), chosen.header.copy(), chosen.shape
            wcs = celestial_header(path, header, hdus)
            if not wcs.has_celestial:
                raise FileError(f"{path}: HDU {number} {chosen.name} has no celestial WCS")
            here = Grid.from_wcs(wcs, shape)
        if grid is None:
            grid = here
        elif here.shape != grid.shape or apart_px(here, grid) > SAME_PX:
            raise FileError(f"{path}: lies on other pixels than {files[0]}: give it a [[mosaic]]")
        indices = [None] if len(shape) == 2 else range(shape[0])
        planes += [FilePlane(path, number, i) for i in indices]
        headers += [header] * len(indices)
    return planes, headers, grid


def _names(name, headers, n):
    """Channels by BAND1, ..., BAND or FILTER of the headers, else the mosaic's name, numbered."""
    if n == 1:
        return [str(headers[0].get("BAND1", headers[0].get("BAND", name))).strip()]
    found = [header.get(f"BAND{i + 1}") for i, header in enumerate(headers)]
    if all(found) and len(set(found)) == n:
        return [str(one).strip() for one in found]
    found = [header.get("BAND", header.get("FILTER")) for header in headers]
    if all(found) and len(set(found)) == n:
        return [str(one).strip() for one in found]
    return [f"{name}{i}" for i in range(n)]


def _zero_points(table, headers, grid, notes):
    """Zero points (C,) [mag]: those given, else those of the headers."""
    if "zero_point" in table:
        given = _listed(table["zero_point"])
        if len(given) not in (1, len(headers)):
            raise ValueError(f"zero_point has {len(given)} numbers for {len(headers)} channels")
        return [float(p) for p in given * (len(headers) if len(given) == 1 else 1)]
    found = [zero_point(header, grid.pixel_scale_arcsec) for header in headers]
    if any(p is None for p in found):
        notes.append(
            f"{table['name']}: no zero point in the header, fluxes stay in counts: give zero_point"
        )
        return [None] * len(headers)
    return found


def _file_planes(folder, table, key, planes, size, inputs):
    """Planes of the files or numbers of a key, one for each channel, of the images' (Ny, Nx)."""
    given, hdu = _listed(table[key]), table.get(f"{key}_hdu")
    found = []
    for one in given:
        if not isinstance(one, str):
            found.append(NumberPlane(float(one)))
            continue
        path = folder / one
        inputs[f"{key} {len(found) + 1} of {table['name']}"] = path
        if hdu is None and path in [plane.path for plane in planes]:
            raise ValueError(
                f"{key} is in the image's own file: {key}_hdu must say which HDU it is"
            )
        with open_fits(path) as hdus:
            chosen = choose_hdu(path, hdus, hdu)
            number, shape = hdus.index(chosen), chosen.shape
        if shape[-2:] != size:
            raise ValueError(f"{key} has {shape[-2:]} pixels ({path}), the images {size}")
        indices = [None] if len(shape) == 2 else range(shape[0])
        found += [FilePlane(path, number, i) for i in indices]
    if len(found) == 1:
        found *= len(planes)
    if len(found) != len(planes):
        raise ValueError(f"{key} has {len(found)} planes, the images {len(planes)}")
    return found


def _weights(folder, table, planes, size, inputs):
    """Planes of weights, variances or RMS, and which of them; None where there are none."""
    for kind in WEIGHTS:
        if kind in table:
            return _file_planes(folder, table, kind, planes, size, inputs), kind
    return [None] * len(planes), "weight"


def _masks(folder, table, planes, size, inputs):
    """Planes of masks, and the bits of each that mean: ignore."""
    if "mask" not in table:
        return [None] * len(planes), [None] * len(planes)
    masks = _file_planes(folder, table, "mask", planes, size, inputs)
    if "mask_bits" not in table:
        return masks, [None] * len(planes)
    values = []
    for mask in masks:
        with open_fits(mask.path) as hdus:
            header = hdus[mask.hdu].header.copy()
        values.append(mask_value(header, table["mask_bits"]))
    return masks, values


def _psf(folder, table, grid, inputs):
    """The PSFField of a table's files."""
    form, files = table.get("psf_format", "image"), _listed(table["psf"])
    given = {"hdu": table.get("psf_hdu"), "spacing": table.get("psf_spacing", 1.0)}
    for key in ("stamp_px", "detector"):
        if f"psf_{key}" in table:
            given[key] = table[f"psf_{key}"]
    if form == "cells":
        if "psf_cell_px" not in table:
            raise ValueError('psf_cell_px is missing: psf_format = "cells" needs a cell\'s size')
        given["cell_px"] = table["psf_cell_px"]
        if "psf_origin_px" in table:
            given["origin_px"] = table["psf_origin_px"]
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)  # said in the notes
        for k, name in enumerate(files):
            inputs[f"PSF {k + 1} of {table['name']}"] = folder / name
            found.append(read_psf_field(folder / name, form, grid, **given))
    return found[0] if len(found) == 1 else BandPSFs(found)
