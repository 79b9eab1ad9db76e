"""SCENE.toml: what a deblending starts from, read with every mistake told by its key.

    [[observation]]                 one table per instrument
    [sources] or [detection]        a catalogue, or how to look for sources
    [frame], [fit]                  optional

`scenekeys.TABLES` lists every key with what is allowed; paths are relative to the file's folder.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..deblending.settings import Settings
from ..deblending.solver.constraints import Chain, Positivity
from ..measurement.detection import THRESHOLD
from ..sky.extent import intersection, union
from ..sky.frame import Frame, model_frame
from ..sky.observation import Observation, check_observations
from ..sky.psf_checks import PSFWarning
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
    inputs, notes, observations = {"scene": path}, [], []
    for i, table in enumerate(tables["observation"]):
        where = f"{path}: observation {i + 1} ({table['name']})"
        observations.append(_observation(where, path.parent, table, inputs, notes))
    try:
        check_observations(observations)
        frame = _frame(path, tables["frame"], observations)
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"{path}: {_by_key(error)}") from error
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


def _observation(where, folder, table, inputs, notes):
    if "weight" in table and "variance" in table:
        raise SceneError(f"{where}: weight and variance are both given: an observation takes one")
    for key in ("weight", "variance", "mask"):
        if f"{key}_hdu" in table and not isinstance(table.get(key), str):
            raise SceneError(f"{where}: {key}_hdu is given, but {key} names no file")
    name = table["name"]
    inputs[f"image of {name}"] = path = folder / table["image"]
    inputs[f"PSF of {name}"] = folder / table["psf"]
    try:
        image = read_image(path, hdu=table.get("hdu"))
        chosen = choose_bands(path, image.bands, table.get("bands"))
        bands = Bands(len(image.data), chosen)
        given = {}
        for key, argument in (("weight", "weights"), ("variance", "variance"), ("mask", "mask")):
            if key not in table:
                continue
            value = table[key]
            if isinstance(value, str):
                inputs[f"{key} of {name}"] = folder / value
                value = _planes(folder / value, table, key, bands)
                value = (np.nan_to_num(value) != 0) if key == "mask" else value
            given[argument] = value
        psf = _psf(folder / table["psf"], table, bands, notes)
        n_channels, names = len(chosen), [image.bands[i] for i in chosen]
        channels = table.get("channels")
        if channels is None and not any(band.isdigit() for band in names):
            channels = names
        if channels is None:
            channels = [name] if n_channels == 1 else [f"{name}{i}" for i in range(n_channels)]
        observation = Observation(
            image.data[chosen],
            psf,
            image.grid,
            channels=channels,
            name=name,
            zero_points=table.get("zero_point"),
            **given,
        )
    except FileError as error:
        raise SceneError(f"{where}: {error}") from error
    except ValueError as error:
        raise SceneError(f"{where}: {_by_key(error)}") from error
    notes += [f"{name}: {message}" for message in observation.messages]
    return observation


def _settings(table):
    """`monotone = false`: morphologies of any form, not negative; structure_px is the prior's."""
    given, default = dict(table), Settings()
    if not given.pop("monotone", True):
        given["constraints"] = Chain(Positivity())
    if "structure_px" in given:
        given["prior"] = replace(default.prior, correlation_px=given.pop("structure_px"))
    return replace(default, **given)


def _by_key(error):
    """An error's text with the file's keys in place of arguments' names."""
    return str(error).replace("zero_points", "zero_point").replace("weights has", "weight has")


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
    center = table.get("psf_center", "middle")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", PSFWarning)
        psf = read_psf(
            path,
            hdu=table.get("psf_hdu"),
            bands=table.get("psf_bands"),
            spacing=table.get("psf_spacing", 1.0),
            center=None if center == "middle" else center,
        )
    if psf.n_bands == bands.n_all and "psf_bands" not in table:
        psf = psf.select(bands.chosen)
    if psf.n_bands not in (1, len(bands.chosen)):
        raise ValueError(
            f"psf has {psf.n_bands} bands, the image {len(bands.chosen)}: choose with bands and "
            "psf_bands"
        )
    messages = dict.fromkeys(str(warning.message) for warning in told)
    notes += [f"{table['name']}: {m.replace('center=', 'psf_center = ')}" for m in messages]
    return psf


def _frame(path, table, observations):
    grid, like = None, table.get("like")
    names = [o.name for o in observations]
    if len(set(names)) < len(names):
        raise SceneError(f"{path}: observation names must be unique, not {', '.join(names)}")
    shared = table.get("footprint") == "intersection"
    if like is not None:
        if like not in names:
            raise SceneError(
                f"{path}: frame: like is {like!r}, it takes the name of an "
                f"observation: {', '.join(names)}"
            )
        grid = (intersection if shared else union)(
            [o.grid for o in observations], like=observations[names.index(like)].grid
        )
    return model_frame(
        observations, grid=grid, shared=shared, psf_sigma_px=table.get("psf_sigma_px", 0.8)
    )
