"""Reads FIELD.toml: opens the mosaics of a field and the options of its run.

    [[mosaic]]                      one table for each instrument
    [sources] or [detection]        a catalogue, or how to look for sources
    [field], [fit]                  optional

docs/fields.md lists every key. Paths are relative to the file's folder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...deblending.settings import Settings
from ...files.scene_keys import SceneError
from ...files.source_table import read_sources
from ..blends.cut import FitLimits
from ..mosaic import Mosaic
from ..options import FieldOptions
from .keys import parse_field
from .mosaic_file import read_mosaic


@dataclass(frozen=True, eq=False)
class FieldFile:
    """A field file with its mosaics opened.

    mosaics: for `run_field`; options: of the file, without workers and memory
    inputs: {what: file}; notes: messages for the user, a line each
    """

    mosaics: tuple[Mosaic, ...]
    options: FieldOptions
    inputs: dict
    notes: tuple[str, ...]


def read_field(path) -> FieldFile:
    """Opens the mosaics that a field file names; pixels are read later, piece by piece.

    path: of the TOML file; its relative paths start from its folder
    Noise estimates read pixels at once. Raises SceneError and FileError: ValueErrors of one line.
    """
    path = Path(path)
    tables = parse_field(path)
    inputs: dict[str, Path] = {"field": path}
    notes: list[str] = []
    mosaics = []
    for i, table in enumerate(tables["mosaic"]):
        try:
            mosaics.append(read_mosaic(path.parent, table, inputs, notes))
        except ValueError as error:
            where = f"{path}: mosaic {i + 1} ({table.get('name', table.get('format'))})"
            raise SceneError(f"{where}: {error}") from error
    return FieldFile(tuple(mosaics), _options(path, tables, inputs), inputs, tuple(notes))


def _options(path, tables, inputs):
    """FieldOptions of the tables other than the mosaics'."""
    about, limits = tables["field"], FitLimits()
    given = {
        key: about[key] for key in ("area", "tile_px", "overlap_px", "margin_px") if key in about
    }
    given |= tables["detection"]
    if "sources" in tables and tables["sources"]:
        inputs["sources"] = path.parent / tables["sources"]["catalogue"]
        try:
            sources = read_sources(inputs["sources"], tables["sources"])
        except ValueError as error:
            raise SceneError(f"{path}: sources: {error}") from error
        if any(s.sky_deg is None for s in sources):
            raise SceneError(f"{path}: sources: a field's are placed by ra and dec")
        given["positions"] = np.array([s.sky_deg for s in sources])
        if any(s.name for s in sources):
            given["names"] = [s.name or "" for s in sources]
    limits = replace(limits, **{k: about[k] for k in ("max_sources", "max_pixels") if k in about})
    try:
        settings = Settings(**tables["fit"])
        return FieldOptions(
            settings=settings, limits=limits, field_number=about.get("field_number", 0), **given
        )
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from error
