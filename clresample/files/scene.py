"""SCENE.toml: what a deblending starts from, read so that every mistake is named by its key.

    [[observation]]                 one table per instrument
    [sources] or [detection]        a catalogue, or how to look for sources
    [frame], [fit]                  optional

`scene_keys.TABLES` lists every key with what is allowed, cli/example.toml shows each with a
comment. Paths are relative to the file's folder.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..deblending.settings import Settings
from ..deblending.solver.constraints import Chain, Positivity
from ..deblending.solver.prior import Prior
from ..measurement.detection import THRESHOLD
from ..sky.extent import intersection, union
from ..sky.frame import Frame, model_frame
from ..sky.observation import Observation, check_observations
from ..sky.psf_checks import PSFWarning, check_edge
from ..sky.sources import Source
from .fits import (
    choose_bands,
    choose_hdu,
    open_fits,
    read_image,
    read_pixels,
    read_psf,
    to_native,
)
from .scene_keys import SceneError, parse
from .source_table import read_sources
from .whole_file import FileError


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene file with all its files read.

    observations, frame, settings: for `deblend`
    sources: of the catalogue; None = detect them, with threshold [sigma] in so many passes
    inputs: {what: file}, for provenance; notes: what the user should know, a line each
    """

    observations: tuple[Observation, ...]
    frame: Frame
    settings: Settings
    sources: tuple[Source, ...] | None
    threshold: float
    passes: int
    inputs: dict
    notes: tuple[str, ...]


class Bands(NamedTuple):
    """Which planes of an image are taken: `chosen` of `n_all`."""

    n_all: int
    chosen: list


def read_scene(path) -> SceneFile:
    """Read a scene file and everything that it names.

    Raises SceneError, and FileError for the images: ValueErrors of one line.
    """
    path = Path(path)
    tables = parse(path)
    inputs, observations = {"scene": path}, []
    notes: list[str] = []
    for i, table in enumerate(tables["observation"]):
        where = f"{path}: observation {i + 1} ({table['name']})"
        try:
            observations.append(_observation(path.parent, table, inputs, notes))
        except ValueError as error:
            raise SceneError(f"{where}: {error}") from error
    try:
        check_observations(observations)
        frame = _frame(tables["frame"], observations)
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from error
    sources = None
    if "sources" in tables:
        inputs["sources"] = path.parent / tables["sources"]["catalogue"]
        try:
            sources = read_sources(inputs["sources"], tables["sources"])
        except ValueError as error:
            raise SceneError(f"{path}: sources: {error}") from error
    detection = tables.get("detection", {})
    return SceneFile(
        tuple(observations),
        frame,
        _settings(tables["fit"]),
        sources,
        detection.get("threshold", THRESHOLD),
        detection.get("passes", 2),
        inputs,
        tuple(notes),
    )


def _observation(folder, table, inputs, notes):
    """The Observation of one table; adds its files to `inputs` and its messages to `notes`."""
    name = table["name"]
    inputs[f"image of {name}"] = folder / table["image"]
    inputs[f"PSF of {name}"] = folder / table["psf"]
    image = read_image(folder / table["image"], hdu=table.get("hdu"))
    chosen = choose_bands(folder / table["image"], image.bands, table.get("bands"))
    bands = Bands(len(image.data), chosen)
    data = image.data[chosen]
    given = _weighting(folder, table, bands, data.shape, inputs)
    zero_points = table.get("zero_point")
    if isinstance(zero_points, list) and len(zero_points) != len(chosen):
        raise ValueError(
            f"zero_point has {len(zero_points)} numbers, it takes one for all channels, or one for "
            f"each of {len(chosen)}"
        )
    observation = Observation(
        data,
        _psf(folder / table["psf"], table, bands, notes),
        image.grid,
        channels=table.get("channels") or _channels(name, [image.bands[i] for i in chosen]),
        name=name,
        zero_points=zero_points,
        **given,
    )
    notes += [f"{name}: {message}" for message in observation.messages]
    return observation


def _channels(name, bands):
    """Names of the channels: those of the bands, or the observation's, numbered if several."""
    if not any(band.isdigit() for band in bands):
        return bands
    return [name] if len(bands) == 1 else [f"{name}{i}" for i in range(len(bands))]


def _weighting(folder, table, bands, shape, inputs):
    """Weights, variance and mask, as Observation takes them; those that are files are read."""
    if "weight" in table and "variance" in table:
        raise ValueError("weight and variance are both given: an observation takes one")
    given = {}
    noise = table.get("noise")
    if noise not in (None, "estimate"):
        inputs[f"noise of {table['name']}"] = folder / noise
        with open_fits(folder / noise) as hdus:
            noise = to_native(read_pixels(folder / noise, choose_hdu(folder / noise, hdus, None)))
    if noise is not None:
        given["noise"] = noise
    for key, argument in (("weight", "weights"), ("variance", "variance"), ("mask", "mask")):
        value = table.get(key)
        if f"{key}_hdu" in table and not isinstance(value, str):
            raise ValueError(f"{key}_hdu is given, but {key} names no file")
        if isinstance(value, str):
            inputs[f"{key} of {table['name']}"] = folder / value
            value = _planes(folder / value, table, key, bands)
        if value is None:
            continue
        value = np.asarray(value)
        if value.shape not in ((), shape[:1], shape[1:], shape):
            raise ValueError(f"{key} has the shape {value.shape}, data {shape}")
        given[argument] = np.nan_to_num(value) != 0 if key == "mask" else value
    return given


def _settings(table):
    """`monotone = true` and `structure_px`, the correlation length, ask for the Prior of one scale
    and its solver; `monotone = false` leaves morphologies any form that is not negative."""
    given = dict(table)
    monotone = given.pop("monotone", None)
    if monotone or "structure_px" in given:
        length = given.pop("structure_px", Prior().correlation_px)
        given["prior"] = Prior(correlation_px=length)
    if monotone is False:
        given["constraints"] = Chain(Positivity())
    return Settings(**given)


def _planes(path, table, key, bands):
    """Pixels (C, Ny, Nx) or (Ny, Nx) of a weight, variance or mask file; they need no WCS."""
    if path.name == Path(table["image"]).name and f"{key}_hdu" not in table:
        raise ValueError(f"{key} is in the image's own file: {key}_hdu must say which HDU it is")
    with open_fits(path) as hdus:
        data = to_native(read_pixels(path, choose_hdu(path, hdus, table.get(f"{key}_hdu"))))
    if data.ndim == 2 or len(data) == 1:
        return data.reshape(data.shape[-2:])
    return data[bands.chosen] if len(data) == bands.n_all else data


def _psf(path, table, bands, notes):
    """The PSF of the bands that are taken; adds its warnings to `notes`."""
    center = table.get("psf_center", "middle")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)  # taken below, with the name of the key
        psf = read_psf(
            path,
            hdu=table.get("psf_hdu"),
            bands=table.get("psf_bands"),
            spacing=table.get("psf_spacing", 1.0),
            center=None if center == "middle" else center,
        )
    try:
        check_edge(psf.images)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error
    notes += [f"{table['name']}: {text}" for text in psf.warnings(core='psf_center = "core"')]
    if psf.n_bands == bands.n_all and "psf_bands" not in table:
        psf = psf.select(bands.chosen)
    if psf.n_bands not in (1, len(bands.chosen)):
        raise ValueError(
            f"psf has {psf.n_bands} bands, the image {len(bands.chosen)}: choose with bands and "
            "psf_bands"
        )
    return psf


def _frame(table, observations):
    grid, like = None, table.get("like")
    names = [o.name for o in observations]
    if len(set(names)) < len(names):
        raise ValueError(f"observation names must be unique, not {', '.join(names)}")
    shared = table.get("footprint") == "intersection"
    if like is not None:
        if like not in names:
            raise ValueError(
                f"frame: like is {like!r}, it takes the name of an observation: {', '.join(names)}"
            )
        grid = (intersection if shared else union)(
            [o.grid for o in observations], like=observations[names.index(like)].grid
        )
    return model_frame(
        observations, grid=grid, shared=shared, psf_sigma_px=table.get("psf_sigma_px", 0.8)
    )
