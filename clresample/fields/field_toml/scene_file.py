"""SCENE.toml: the start of a deblending, read so that every mistake is named by its key.

    [[observation]]                 one table per instrument, with the keys of a field's [[mosaic]]
    [sources] or [detection]        a catalogue, or how to look for sources
    [frame], [fit]                  optional

`keys.SCENE_TABLES` lists every key with what is allowed, cli/example.toml shows each with a
comment. Paths are relative to the file's folder.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ...deblending.settings import FitSettings, Settings
from ...files.scene_keys import SceneError
from ...files.source_table import read_sources
from ...measurement.detection import THRESHOLD
from ...paper.settings import PaperSettings
from ...paper.solver.constraints import Positivity, ProxChain
from ...paper.solver.prior import SingleScalePrior
from ...sky.box import Box
from ...sky.extent import grid_intersection, grid_union
from ...sky.frame import Frame, grow_to_sources, model_frame
from ...sky.noise import NoiseWarning
from ...sky.observation import Observation, check_observations
from ...sky.psf_checks import PSFWarning
from ...sky.sources import Source
from ..mosaic import rms_squared, saturations
from .estimates import subtract_background
from .keys import parse_scene
from .mosaic_file import open_mosaic


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene file with all its files read.

    observations, frame, settings: for `deblend`
    sources: of the catalogue; None = detect them, with threshold [sigma] and number of passes
    inputs: {what: file}, for provenance; notes: messages for the user, a line each
    """

    observations: tuple[Observation, ...]
    frame: Frame
    settings: FitSettings
    sources: tuple[Source, ...] | None
    threshold: float
    passes: int
    inputs: dict
    notes: tuple[str, ...]


def read_scene(path) -> SceneFile:
    """Reads a scene file and all files that it names.

    path: of the TOML file; its relative paths start from its folder
    Raises SceneError, and FileError for the images: ValueErrors of one line.
    """
    path = Path(path)
    tables = parse_scene(path)
    inputs, mosaics = {"scene": path}, []
    notes: list[str] = []
    for i, table in enumerate(tables["observation"]):
        where = f"{path}: observation {i + 1} ({table.get('name', table.get('format'))})"
        try:
            mosaics.append(_mosaic(path.parent, table, inputs, notes))
        except ValueError as error:
            raise SceneError(f"{where}: {error}") from error
    observations = []
    calibrated = all(c.zero_point is not None for m in mosaics for c in m.channels)
    for i, (table, mosaic) in enumerate(zip(tables["observation"], mosaics, strict=True)):
        try:
            observations.append(_observation(mosaic, table, calibrated))
        except ValueError as error:
            where = f"{path}: observation {i + 1} ({mosaic.name})"
            raise SceneError(f"{where}: {error}") from error
        notes += [f"{mosaic.name}: {message}" for message in observations[-1].messages]
    try:
        check_observations(observations)
        frame = _frame(tables["frame"], observations)
        settings = _settings(tables["fit"])
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from error
    sources = None
    if "sources" in tables:
        inputs["sources"] = path.parent / tables["sources"]["catalogue"]
        try:
            sources = read_sources(inputs["sources"], tables["sources"])
        except ValueError as error:
            raise SceneError(f"{path}: sources: {error}") from error
        if tables["frame"].get("footprint") != "intersection":
            frame = grow_to_sources(frame, observations, sources)
    detection = tables.get("detection", {})
    return SceneFile(
        tuple(observations),
        frame,
        settings,
        sources,
        detection.get("threshold", THRESHOLD),
        detection.get("passes", 2),
        inputs,
        tuple(notes),
    )


def _mosaic(folder, table, inputs, notes):
    """The Mosaic of one table in memory, its sky subtracted where that is given."""
    mosaic = open_mosaic(folder, table, inputs, notes, in_memory=True)
    return mosaic if "format" in table else subtract_background(mosaic, table)


def _observation(mosaic, table, calibrated):
    """The Observation of all of a Mosaic.

    calibrated: True if all observations have zero points; otherwise zero points are ignored, so
        that all fluxes are in counts
    """
    box, channels = Box.of(mosaic.grid.shape), mosaic.channels
    given = {"noise": "estimate"} if table.get("noise") == "estimate" else {"noise": mosaic.noise}
    given = given if mosaic.noise is None else {"noise": mosaic.noise}
    if any(c.mask is not None for c in channels):
        given["mask"] = np.stack([c.masked(box) for c in channels])
    if channels[0].weight is not None:
        values = np.stack([_values(c.weight, box) for c in channels])
        values = rms_squared(values) if channels[0].weight_kind == "rms" else values
        given["weights" if channels[0].weight_kind == "weight" else "variance"] = values
    if calibrated:
        given["zero_points"] = [c.zero_point for c in channels]
    with warnings.catch_warnings():
        for kind in (NoiseWarning, PSFWarning):  # in the notes already
            warnings.simplefilter("ignore", kind)
        return Observation(
            np.stack([c.read(box) for c in channels]),
            mosaic.psf if mosaic.psf.varies else mosaic.psf.psf_at(0, 0),
            mosaic.grid,
            channels=[c.name for c in channels],
            bands=[c.band or c.name for c in channels],
            saturation=saturations(channels, box),
            name=mosaic.name,
            **given,
        )


def _values(plane, box):
    return np.asarray(plane.read(box), np.float64)


def _settings(table):
    """Settings of the table [fit].

    `monotone = true` and `correlation_px`, the correlation length, select the SingleScalePrior and
    its solver, the paper's; `monotone = false` leaves morphologies any form that is not negative.
    """
    given = dict(table)
    monotone = given.pop("monotone", None)
    kind = PaperSettings if monotone or "correlation_px" in given else Settings
    if kind is PaperSettings:
        length = given.pop("correlation_px", SingleScalePrior().correlation_px)
        given["prior"] = SingleScalePrior(correlation_px=length)
        if monotone is False:
            given["constraints"] = ProxChain(Positivity())
    for name in given.keys() - {field.name for field in fields(kind)}:
        raise ValueError(
            f"fit: {name} is {given[name]!r}, but goes "
            + ("without" if kind is PaperSettings else "with")
            + " monotone = true or correlation_px: leave one of them out"
        )
    return kind(**given)


def _frame(table, observations):
    grid, reference = None, table.get("reference")
    names = [o.name for o in observations]
    if len(set(names)) < len(names):
        raise ValueError(f"observation names must be unique, not {', '.join(names)}")
    shared = table.get("footprint") == "intersection"
    if reference is not None:
        if reference not in names:
            raise ValueError(
                f"frame: reference is {reference!r}, must be the name of an observation: "
                f"{', '.join(names)}"
            )
        grid = (grid_intersection if shared else grid_union)(
            [o.grid for o in observations], like=observations[names.index(reference)].grid
        )
    return model_frame(
        observations, grid=grid, shared=shared, psf_sigma_px=table.get("psf_sigma_px", 0.8)
    )
