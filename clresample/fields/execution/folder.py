"""The folder of a run: its owner, and whether another run may continue it."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np

from ...files.atomic import FileError, atomic_file, check_folder, remove_stale, remove_tree
from ..sky_level import FILE as SKY_FILE
from .search_setup import FILE as LOOK_FILE

WORK = "work"  # folder of the parts inside the output folder
FORMAT = 14  # of that folder; raised when another version would misread it
MEMORY_KEYS = "memory", "max_bytes"  # keys of it that a resumed run takes from the first one


def open_folder(folder, mosaics, reference, options, resume, overwrite, progress, inputs=()):
    """Creates or reopens the folder of group results; returns it and the options.

    The returned options have the memory of the earlier run, because it determines which blends are
    fitted side by side, and which are cut.

    inputs: files whose sizes and times must be unchanged in a resumed run

    Raises FileError for the folder of another run.
    """
    work, mine = folder / WORK, _fingerprint(mosaics, reference, options, inputs)
    check_folder(folder)
    if overwrite and work.exists():
        remove_tree(work)
    there = work / "run.json"
    _check_format(folder, there)
    if there.exists() and (work / LOOK_FILE).exists():  # before it nothing is done
        if not resume:
            raise FileError(f"{folder}: holds a run already: --resume goes on, --overwrite forgets")
        before = json.loads(there.read_text())
        other = [key for key in mine if key not in MEMORY_KEYS and before.get(key) != mine[key]]
        if other:
            raise FileError(
                f"{folder}: holds a run with another {other[0]}, {before.get(other[0])!r} and not "
                f"{mine[other[0]]!r}: --overwrite forgets it"
            )
        progress.message(f"going on with the run in {folder}")
        remove_stale(work)  # files in the midst of which it was killed
        limits = replace(options.limits, max_bytes=before["max_bytes"])
        return work, replace(options, group_memory=before["memory"], limits=limits)
    try:
        work.mkdir(parents=True, exist_ok=True)
        (work / SKY_FILE).unlink(missing_ok=True)  # of a start that ended before the search
    except OSError as error:
        raise FileError(f"{work}: cannot be made ({error.strerror or error})") from error
    with atomic_file(there) as part:
        part.write_text(json.dumps(mine, indent=1))
    return work, options


def _check_format(folder, path):
    """Raises FileError for the folder of a run by a version with another format."""
    found = json.loads(path.read_text()).get("format", 1) if path.exists() else FORMAT
    if found != FORMAT:
        raise FileError(
            f"{folder}: holds a run of format {found}, this version goes on with {FORMAT}: "
            "--overwrite forgets it"
        )


def _fingerprint(mosaics, reference, options, inputs):
    """Properties that a resumed run must share with the one before, in values that JSON returns."""
    positions = options.positions
    return {
        "format": FORMAT,
        "mosaics": [[m.name, *m.grid.shape, *(c.name for c in m.channels)] for m in mosaics],
        "corner": np.round(reference.sky(0, 0), 9).tolist(),
        "settings": repr(options.settings),
        "threshold": options.threshold,
        "passes": options.passes,
        "sources": None if positions is None else np.round(positions, 9).tolist(),
        "area": options.area,
        "part": options.part and [*options.part, options.margin_px],
        "tile_px": options.tile_px,
        "overlap_px": options.overlap_px,
        "limits": [options.limits.max_sources, options.limits.max_pixels],
        "memory": options.group_memory,
        "max_bytes": options.limits.max_bytes,
        "field_number": options.field_number,
        "inputs": {str(f): _size_and_time(f) for f in inputs},
    }


def _size_and_time(path):
    """[bytes, ns] of a file; None where it is not there."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return [found.st_size, found.st_mtime_ns]
