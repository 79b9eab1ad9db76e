"""Builds a Mosaic from the files that a reader located and the options of its caller."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...files.atomic import FileError
from ...files.fits import celestial_header, choose_hdu, open_fits
from ...sky.grid import Grid
from ...sky.psf import PSF
from ...sky.psf_checks import PSFWarning
from ..field_toml.estimates import (
    estimate_noise_correlation,
    estimate_weights,
    sample_box,
    subtract_background,
)
from ..mosaic import Channel, FilePlane, Mosaic, Plane
from ..psfs.combined import ConstantPSF, PerBandPSF, PSFField

SAME_PX = 1e-3  # [px] distance of corners below which bands have the same pixels
# [1] of the pixels in a mosaic's middle; a larger masked fraction causes a note
MANY_MASKED = 0.1


@dataclass(frozen=True, eq=False)
class ReaderOptions:
    """Options of a reader; those that are None are read, or are the format's own.

    name: of the mosaic, unique in a field; bands: those to read, by the format's names
    channels (C,): their names, unique in a field
    band (C,): of which they are exposures, where several mosaics have some; see Observation
    mask_bits: bits that mean: ignore this pixel, by number or name
    zero_point [mag]: AB of one count, one number or C of them
    psf: PSF or PSFField for all bands, a list with one for each, or a function that makes one of
        the mosaic's Grid
    background: "subtract", or "none" where it is subtracted already
    noise: "estimate" its correlation, or "white"
    saturation [counts]: one number or C of them
    inputs {what: file}, notes: filled with the files, and with messages for the user
    """

    name: str | None = None
    bands: object = None
    channels: object = None
    band: object = None
    mask_bits: object = None
    zero_point: object = None
    psf: object = None
    background: str = "none"
    noise: str | None = None
    saturation: object = None
    inputs: dict = field(default_factory=dict)
    notes: list = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class BandFiles:
    """One band of a mosaic, as a reader finds it.

    band: the format's name of it; grid, data, weight, kind, mask, mask_value, zero_point: as in
        Channel, None if the file has none; psf: PSFField, or None
    noise: NoiseCorrelation, or None; saturation [counts]: of the image's pixels, or None
    missing_zero_point, missing_psf: why there is none
    files {what: file}
    """

    band: str
    grid: Grid
    data: FilePlane
    weight: Plane
    kind: str
    mask: Plane | None = None
    mask_value: int | None = None
    zero_point: float | None = None
    psf: PSFField | None = None
    noise: object = None
    saturation: float | None = None
    missing_zero_point: str = "its header does not say"
    missing_psf: str = "the format holds none"
    files: dict = field(default_factory=dict)


def paths_of(given) -> list[Path]:
    """A path or several as a list of Path. Raises FileError for one that does not exist."""
    paths = [Path(one) for one in (given if isinstance(given, list | tuple) else [given])]
    for path in paths:
        if not path.exists():
            raise FileError(f"{path}: no such file or folder")
    return paths


def files_at(paths) -> list[Path]:
    """All files of the folders, and beside the files, of a list of paths, sorted by name."""
    folders = {path if path.is_dir() else path.parent for path in paths}
    try:
        return sorted(file for folder in folders for file in folder.iterdir())
    except OSError as error:
        raise FileError(f"{error.filename}: cannot be read ({error.strerror})") from error


def image_plane(path, hdu=None) -> tuple[FilePlane, tuple, object, Grid | None]:
    """An image HDU of two axes: its plane, shape, header and Grid, None without a celestial WCS.

    The primary header's cards count where the HDU's own header lacks them, as with INHERIT.
    Raises FileError for a file without it.
    """
    with open_fits(path) as hdus:
        chosen = choose_hdu(path, hdus, hdu)
        if len(chosen.shape) != 2:
            raise FileError(f"{path}: HDU {chosen.name} has {len(chosen.shape)} axes, must have 2")
        number, shape = hdus.index(chosen), chosen.shape
        header = hdus[0].header.copy()
        header.extend(chosen.header, update=True)
        wcs = celestial_header(path, chosen.header.copy(), hdus)
        grid = Grid.from_wcs(wcs, shape) if wcs.has_celestial else None
    return FilePlane(Path(path), number), shape, header, grid


def matching_plane(grid, path, hdu=None) -> tuple[FilePlane, object]:
    """A plane that belongs to an image, and its header. Raises FileError for other pixels."""
    plane, shape, header, _ = image_plane(path, hdu)
    if shape != grid.shape:
        what = "" if hdu is None else f" HDU {hdu}"
        raise FileError(f"{path}:{what} has {shape} pixels, its image {grid.shape}")
    return plane, header


def require_grid(path, grid) -> Grid:
    """The grid. Raises FileError where there is none."""
    if grid is None:
        raise FileError(f"{path}: has no celestial WCS")
    return grid


def assemble_mosaic(survey, found, given, *, noise="white") -> Mosaic:
    """Assembles a Mosaic from a reader's files and its user's options.

    survey: its name where none is given; found: sequence of BandFiles; given: ReaderOptions
    noise: default treatment of its correlation
    Raises ValueError, one line, for missing or inconsistent files and options.
    """
    found = _chosen(found, given.bands)
    name = given.name or survey
    grid = found[0].grid
    for other in found[1:]:
        if other.grid.shape != grid.shape or corner_distance_px(other.grid, grid) > SAME_PX:
            raise ValueError(
                f"bands {found[0].band} and {other.band} lie on other pixels: give each a mosaic"
            )
    names = _one_for_each("channels", given.channels, found) or [one.band for one in found]
    points = _zero_points(found, given)
    psf, levels = _psf(found, given, grid), _saturations(found, given)
    exposed = _one_for_each("band", given.band, found) or [None] * len(found)
    channels = tuple(
        Channel(
            *(names[i], f.data, f.weight, f.kind, f.mask, f.mask_value, points[i]),
            saturation=levels[i],
            band=exposed[i],
        )
        for i, f in enumerate(found)
    )
    for one in found:
        given.inputs.update({f"{what} of {name} {one.band}": f for what, f in one.files.items()})
    mosaic = Mosaic(name, grid, channels, psf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        middle = psf.psf_at(*((np.array(grid.shape) - 1) / 2))
    given.notes.extend(f"{name}: {text}" for text in middle.warnings())
    _tell_of_masks(mosaic, given)
    packed = sorted({str(f.data.path.name) for f in found if f.data.path.suffix == ".gz"})
    if packed:
        given.notes.append(
            f"{name}: {', '.join(packed)}: each piece that is read unpacks the file from its "
            "start; large ones are read faster unpacked"
        )
    mosaic = subtract_background(mosaic, {"background": given.background})
    mosaic = estimate_weights(mosaic, given.notes)
    if given.noise is None and all(one.noise is not None for one in found):
        return replace(mosaic, noise=tuple(one.noise for one in found))
    try:
        return estimate_noise_correlation(mosaic, {"noise": given.noise or noise}, given.notes)
    except ValueError as error:
        raise ValueError(f'noise: {error}: give noise = "white", or a larger image') from None


def corner_distance_px(one, other) -> float:
    """Largest distance [px] of the corners of two grids of one shape."""
    n, m = (
        np.array([0, 0, size - 1, size - 1.0])[order]
        for size, order in zip(one.shape, ([0, 1, 2, 3], [0, 2, 1, 3]), strict=True)
    )
    return float(np.abs(one.positions_in(other, n, m) - np.stack([n, m], axis=-1)).max())


def _chosen(found, bands):
    """The selected bands, in their order."""
    if bands is None:
        return list(found)
    there = {one.band: one for one in found}
    bands = [bands] if isinstance(bands, str) else list(bands)
    for band in bands:
        if band not in there:
            raise ValueError(f"bands has {band!r}, there are {', '.join(there)}")
    return [there[band] for band in bands]


def _one_for_each(what, value, found):
    """A list with one value for each band, or None."""
    if value is None:
        return None
    values = list(value) if isinstance(value, list | tuple | np.ndarray) else [value]
    if len(values) != len(found):
        raise ValueError(f"{what} has {len(values)} values for {len(found)} bands")
    return values


def _saturations(found, given):
    if given.saturation is None:
        return [one.saturation for one in found]
    return _numbers("saturation", given.saturation, found)


def _numbers(what, value, found):
    """The number given for each band, or the one for all of them."""
    values = [value] * len(found) if np.ndim(value) == 0 else list(value)
    return [float(v) for v in _one_for_each(what, values, found)]


def _zero_points(found, given):
    if given.zero_point is not None:
        return _numbers("zero_point", given.zero_point, found)
    for one in found:
        if one.zero_point is None:
            raise ValueError(
                f"zero_point of band {one.band} is missing, {one.missing_zero_point}: "
                f"give zero_point ({one.data.path.name})"
            )
    return [one.zero_point for one in found]


def _psf(found, given, grid):
    """The PSFField given, else that of the bands."""
    psf: Callable | object = given.psf
    if callable(psf) and not isinstance(psf, PSF | PSFField):
        psf = psf(grid)
    if psf is not None and not isinstance(psf, list | tuple):
        return psf if isinstance(psf, PSFField) else ConstantPSF(psf)
    for one in found if psf is None else ():
        if one.psf is None:
            raise ValueError(
                f"psf of band {one.band} is missing, {one.missing_psf}: "
                f"give psf ({one.data.path.name})"
            )
    fields = [one.psf for one in found] if psf is None else _one_for_each("psf", psf, found)
    fields = [one if isinstance(one, PSFField) else ConstantPSF(one) for one in fields]
    return fields[0] if len(fields) == 1 else PerBandPSF(fields)


def _tell_of_masks(mosaic, given):
    """A note where the mask takes much of the mosaic's middle and its bits were not chosen."""
    if given.mask_bits is not None:
        return
    box = sample_box(mosaic.grid)
    for channel in mosaic.channels:
        if channel.mask is None:
            continue
        share = float(channel.masked(box).mean())
        if share > MANY_MASKED:
            given.notes.append(
                f"{mosaic.name}: {share:.0%} of the pixels in the middle of channel "
                f"{channel.name} are masked; mask_bits says which bits count"
            )
