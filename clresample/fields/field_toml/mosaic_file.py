"""One image table of a scene or field file, opened as a Mosaic."""

from __future__ import annotations

import warnings

import numpy as np

from ...files.fits import choose_bands
from ...sky.psf_checks import PSFWarning
from ..mosaic import Channel, Mosaic
from ..readers.formats import read_survey
from .estimates import estimate_noise_correlation, estimate_weights, subtract_background
from .headers import saturation, zero_point
from .image_files import BandSelection, ImageFiles, as_list
from .keys import SHARED
from .psf_keys import CORE, read_psf_keys


def read_mosaic(folder, table, inputs, notes) -> Mosaic:
    """The Mosaic of one table with all that is estimated; adds its files to `inputs`.

    folder: that the files' names are relative to; table: of `parse_field`
    notes: a list, messages for the user are added
    Raises FileError and ValueError, of one line, for what cannot be used.
    """
    mosaic = open_mosaic(folder, table, inputs, notes)
    if "format" in table:
        return mosaic  # estimated by its reader
    mosaic = estimate_weights(subtract_background(mosaic, table), notes)
    return estimate_noise_correlation(mosaic, table, notes)


def open_mosaic(folder, table, inputs, notes, *, in_memory=False) -> Mosaic:
    """The Mosaic of one table as its files describe it; only surveys' files have estimates.

    in_memory: read all pixels now; else piece by piece, later. Other arguments as `read_mosaic`
    Raises FileError and ValueError, of one line, for what cannot be used.
    """
    if "format" in table:
        return _survey(folder, table, inputs, notes)
    name, source = table["name"], ImageFiles(folder, table, inputs, in_memory)
    images = source.images()
    chosen = choose_bands(images.path, images.names, table.get("bands"))
    bands = BandSelection(images.names, chosen, images.grid.shape)
    planes, headers = [images.planes[i] for i in chosen], [images.headers[i] for i in chosen]
    names = _channels(table, [images.names[i] for i in chosen])
    points = _zero_points(table, headers, images.grid, notes)
    weights, kind = source.weights(bands)
    masks, bits = source.masks(bands)
    levels, exposed = _saturations(table, headers), _bands(table, len(planes))
    channels = [
        Channel(
            *(names[i], plane, weights[i], kind, masks[i], bits[i], points[i]),
            saturation=levels[i],
            band=exposed[i],
        )
        for i, plane in enumerate(planes)
    ]
    psf = read_psf_keys(folder, table, images.grid, headers[0], bands, inputs, notes)
    mosaic = Mosaic(name, images.grid, tuple(channels), psf, source.noise(len(planes)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        middle = psf.psf_at(*((np.array(images.grid.shape) - 1) / 2))
    notes += [f"{name}: {text}" for text in middle.warnings(core=CORE)]
    return mosaic


def _survey(folder, table, inputs, notes):
    """The Mosaic of a table with a survey's files."""
    keys = (*SHARED, "bands", "noise")
    given = {key: table[key] for key in keys if key in table}
    if isinstance(given.get("channels"), str):
        given["channels"] = [given["channels"]]
    if "psf" in table:
        about = {"name": table.get("name", table["format"])} | table
        given["psf"] = lambda grid: read_psf_keys(folder, about, grid, None, None, inputs, notes)
    paths = [folder / one for one in as_list(table["path"])]
    return read_survey(table["format"], paths, inputs=inputs, notes=notes, **given)


def _channels(table, bands):
    """Names of the channels: those given, those of the bands, or the image's, numbered."""
    name, n = table["name"], len(bands)
    if "channels" in table:
        names = as_list(table["channels"])
        if len(names) != n:
            raise ValueError(f"channels has {len(names)} names, data have {n} channels")
        return names
    if len(set(bands)) == n and not any(band.isdigit() for band in bands):
        return bands
    return [name] if n == 1 else [f"{name}{i}" for i in range(n)]


def _bands(table, n):
    """Bands (n,) of the channels, None where each has its own."""
    if "band" not in table:
        return [None] * n
    names = as_list(table["band"])
    if len(names) not in (1, n):
        raise ValueError(f"band has {len(names)} names, must have one, or one for each of {n}")
    return names * (n if len(names) == 1 else 1)


def _zero_points(table, headers, grid, notes):
    """Zero points (C,) [mag]: those given, else those of the headers."""
    if "zero_point" in table:
        return _numbers(table, "zero_point", len(headers))
    found = [zero_point(header, grid.pixel_scale_arcsec) for header in headers]
    if any(p is None for p in found):
        notes.append(
            f"{table['name']}: no zero point in the header, fluxes stay in counts: give zero_point"
        )
        return [None] * len(headers)
    return found


def _saturations(table, headers):
    """Saturation levels (C,) [counts] of the file: those given, or SATURATE; None: unknown."""
    if "saturation" in table:
        return _numbers(table, "saturation", len(headers))
    return [saturation(header) for header in headers]


def _numbers(table, key, n):
    """The numbers (n,) of a key."""
    given = [float(value) for value in as_list(table[key])]
    if len(given) not in (1, n):
        raise ValueError(
            f"{key} has {len(given)} numbers, must have one for all channels, or one for each "
            f"of {n}"
        )
    return given * (n if len(given) == 1 else 1)
