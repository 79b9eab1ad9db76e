"""Files in the folder of a run, finished or not, as the report reads them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.table import QTable

from ..fields.execution.folder import WORK
from ..fields.execution.group_results import GroupResultsFile, last_rounds
from ..fields.model_mosaics import file_name
from ..files.atomic import FileError
from ..files.tables import read_catalogue
from ..measurement.columns import Columns
from .instrument import Instrument, instruments_in


@dataclass(frozen=True, eq=False)
class RunFolder:
    """A run's folder.

    folder; sources: QTable of the catalogue, of what is fitted so far where the run is not
        finished; fits: QTable of fit_table.ecsv
    instruments: with model and residual mosaics, the smallest pixels first
    provenance: of provenance.json, {} where there is none; settings: of the run
    finished: True if the catalogue exists; done: {stage: (number done, total)} if it does not
    notes: what is missing or cannot be read, a line each
    """

    folder: Path
    sources: QTable
    fits: QTable
    instruments: tuple[Instrument, ...] = ()
    provenance: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    finished: bool = True
    done: dict = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels, in the order of the catalogue's columns."""
        names = [c.removeprefix("flux_err_") for c in self.sources.colnames if "flux_err_" in c]
        return tuple(names) or tuple(c for i in self.instruments for c in i.channels)

    @property
    def offset(self) -> np.ndarray:
        """(2,) [px]: (y, x) of the first pixel of the first instrument's mosaics in the field.

        They begin elsewhere than the field where it was run in parts.
        """
        corner = self.settings.get("corner")
        if not self.instruments or not self.settings.get("part") or not corner:
            return np.zeros(2)
        if "y_sky" in self.sources.colnames:  # flat: written with (0, 0) at RA = Dec = 0
            corner = -corner[1] / 3600, corner[0] / 3600
        with np.errstate(invalid="ignore"):
            first = -self.instruments[0].grid.pixel(*map(float, corner))
        return np.rint(first) if np.isfinite(first).all() else np.zeros(2)


def read_run(folder) -> RunFolder:
    """Reads a run's folder. Raises FileError without a run, or if its catalogue is damaged."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileError(f"{folder}: no such folder")
    begun = (folder / WORK / "run.json").is_file()
    catalogue = _first(folder, ("catalogue.fits", "catalogue.ecsv"))
    if catalogue is None and not begun:
        raise FileError(
            f"{folder}: holds no run of `clresample field`: neither catalogue.fits nor "
            f"{WORK}/run.json"
        )
    notes: list[str] = []
    provenance = _json(folder / "provenance.json", notes) if catalogue else {}
    settings = provenance.get("run") or {}
    if not isinstance(settings, dict) or not settings:
        settings = _json(folder / WORK / "run.json", notes) if begun else {}
    done = {} if catalogue else _done(folder / WORK)
    sources, fits = _so_far(folder / WORK, notes) if catalogue is None else _finished(folder, notes)
    return RunFolder(
        folder,
        sources,
        fits,
        tuple(instruments_in(folder, notes, _names(settings))) if catalogue else (),
        provenance,
        settings,
        catalogue is not None,
        done,
        tuple(notes),
    )


def _names(settings):
    """{part of a file's name: name of the mosaic}."""
    try:
        names = [str(one[0]) for one in settings.get("mosaics", ())]
    except (TypeError, IndexError, KeyError):
        return {}
    return {file_name(name): name for name in names}


def _first(folder, names):
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _finished(folder, notes):
    """The catalogue and the fits of a run that has ended."""
    path = _first(folder, ("catalogue.fits", "catalogue.ecsv"))
    sources = read_catalogue(path)
    if len(sources.colnames) and not {"id", "y", "x"} <= set(sources.colnames):
        raise FileError(f"{path}: has no columns id, y and x: not the catalogue of a field")
    fits = QTable()
    if (folder / "fit_table.ecsv").is_file():
        fits = read_catalogue(folder / "fit_table.ecsv")
    else:
        notes.append("fit_table.ecsv does not exist: the report has no table of fits")
    return sources, fits


def _json(path, notes):
    """A JSON object; {} with a note where it is not one."""
    try:
        found = json.loads(path.read_text())
        if isinstance(found, dict):
            return found
        reason = "no JSON object"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
    notes.append(f"{path.name} cannot be read ({reason})")
    return {}


def _done(work):
    """{"tiles searched": ..., "fits": ...} of an unfinished run: (done, total or None)."""
    tiles = len(list(work.glob("tile-*.npz")))
    notes: list[str] = []
    plan = _json(work / "plan.json", notes) if (work / "plan.json").is_file() else None
    done = {"tiles searched": (tiles, tiles if plan is not None else None)}
    if plan is not None:
        done["blends fitted"] = (0, len(plan.get("patches", ())))
    return done


def _so_far(work, notes):
    """Sources and fits of the groups that are finished, the last round's of each fit."""
    parts = []
    for path in sorted(work.glob("fit-*.arrays")):
        part = GroupResultsFile(path)
        try:
            parts.append(part.read("PATCHES", "CATALOGUE"))
        except FileError as error:
            notes.append(str(error))
    last, tables, fits = last_rounds([patches for patches, _ in parts]), [], []
    for i, (patches, rows) in enumerate(parts):
        mine = np.array([last[number] == i for number in patches["fit_id"].tolist()], bool)
        fits.append(patches.select_rows(mine))
        tables.append(rows.select_rows(np.repeat(mine, patches["n_sources"])))
    of_both = ([rows for rows in some if len(rows)] for some in (tables, fits))
    sources, fits = (Columns.concatenate(some).table() for some in of_both)
    return (
        sources[np.argsort(sources["id"], kind="stable")] if len(sources) else sources,
        fits[np.argsort(fits["fit_id"], kind="stable")] if len(fits) else fits,
    )
