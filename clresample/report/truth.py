"""Compares a catalogue with the truth of a simulated field, matched source by source."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import QTable
from scipy.spatial import cKDTree

from ..files.atomic import FileError
from ..files.tables import read_catalogue
from .stamps import plain

# [px] Largest distance of a row from its true source. With a larger one unrelated sources would be
# matched; with a smaller one faint sources would be lost by the noise of their positions.
FOUND_PX = 4.0
EDGE_PX = 8.0  # [px] true sources nearer to the field's edge are not counted


@dataclass(frozen=True, eq=False)
class TruthMatch:
    """True sources (T) beside the catalogue's rows (S).

    path; table: columns flux_CHANNEL [uJy], snr where it is given
    matched_rows (T,): the catalogue's row that is its own, -1 for none
    inner (T,) bool: well on the field, so that it could be found
    """

    path: Path
    table: QTable
    matched_rows: np.ndarray
    is_interior: np.ndarray

    def pulls(self, run, channel):
        """(flux - truth) / error of the sources found in a channel; empty where it has none."""
        names = f"flux_{channel}", f"flux_err_{channel}"
        if names[0] not in self.table.colnames or not set(names) <= set(run.sources.colnames):
            return np.zeros(0)
        if str(run.sources[names[0]].unit) != "uJy":
            return np.zeros(0)
        found = self.matched_rows >= 0
        flux, error = (plain(run.sources[name])[self.matched_rows[found]] for name in names)
        with np.errstate(divide="ignore", invalid="ignore"):
            pulls = (flux - plain(self.table[names[0]])[found]) / error
        return pulls[np.isfinite(pulls)]


def truth_of(run, path, notes) -> TruthMatch | None:
    """The truth at a path, or that which lies in the run's folder or beside its inputs.

    path: None = look for truth.ecsv; None is returned where there is none

    Raises FileError where `path` is given and is no truth; of one that was found, a note tells.
    """
    places = [Path(path)] if path is not None else _places(run)
    for place in places:
        try:
            if path is None and not place.is_file():
                continue
            return _read(run, place)
        except FileError as error:
            if path is not None:
                raise
            notes.append(str(error))
    return None


def _places(run):
    """Folders to which `clresample simulate field` writes the truth: beside the input files."""
    inputs = run.provenance.get("inputs") or run.settings.get("inputs") or {}
    files = [v.get("file", "") if isinstance(v, dict) else k for k, v in inputs.items()]
    folders = [run.folder, run.folder.absolute().parent, *(Path(str(f)).parent for f in files)]
    return list(dict.fromkeys(folder / "truth.ecsv" for folder in folders))


def _read(run, path):
    table = read_catalogue(path)
    names = set(table.colnames)
    if not {"y", "x"} <= names or not any(name.startswith("flux_") for name in names):
        raise FileError(
            f"{path}: is not the truth of a field: it must have y, x [px] and flux_CHANNEL"
        )
    true = np.stack([plain(table[c]) for c in ("y", "x")], axis=1)
    rows = run.sources
    at = np.stack([plain(rows[c]) for c in ("y", "x")], axis=1) if len(rows) else np.zeros((0, 2))
    return TruthMatch(Path(path), table, matched(at, true), _inner(run, true))


def _inner(run, true):
    """(T,) bool: on the first instrument's mosaic, away from its edge."""
    if not run.instruments:
        return np.ones(len(true), bool)
    low = run.offset + EDGE_PX
    high = run.offset + np.array(run.instruments[0].grid.shape) - 1 - EDGE_PX
    return ((true > low) & (true < high)).all(axis=1)


def matched(at, true):
    """(T,) For each true position (T, 2) the row of `at` (S, 2) that is its own, or -1.

    Pairs within FOUND_PX are taken in the order of their distance, each row and true source once.
    """
    found = np.full(len(true), -1)
    rows, known = (np.flatnonzero(np.isfinite(p).all(axis=1)) for p in (at, true))
    if not len(rows) or not len(known):
        return found
    near = cKDTree(true[known]).sparse_distance_matrix(
        cKDTree(at[rows]), FOUND_PX, output_type="ndarray"
    )
    taken = np.zeros(len(at), bool)
    for k in np.lexsort((near["j"], near["i"], near["v"])):
        t, row = known[near["i"][k]], rows[near["j"][k]]
        if found[t] < 0 and not taken[row]:
            found[t], taken[row] = row, True
    return found
