"""Simulated fields run as users do, and searched alone."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.table import QTable

from clresample.cli.simulate import write_field
from clresample.fields.blends.search import search_tile, snr_scatter
from clresample.fields.blends.tiles import tiles_of
from clresample.fields.field_toml.field_file import read_field
from clresample.fields.options import FieldOptions
from clresample.fields.run import reference_grid
from clresample.sky.box import Box

from .memory import TreeMemory
from .options import ROOT


def found_in(field, folder):
    """Positions (R, 2) [model px] that the search alone finds in a field's files.

    Returns also its processor and wall time [s].
    """
    mosaics = read_field(write_field(folder, field)[0]).mosaics
    core, wall = time.process_time(), time.perf_counter()
    reference, options = reference_grid(mosaics), FieldOptions()
    tiles = tiles_of(Box.of(reference.shape), options.tile_px, options.overlap_px)
    scatters = snr_scatter(mosaics, reference)
    found = [
        search_tile(
            mosaics, reference, tile, threshold=options.threshold, scatters=scatters
        ).positions
        for tile in tiles
    ]
    return np.concatenate(found), time.process_time() - core, time.perf_counter() - wall


def fitted(field, workers):
    """The command on a field: its catalogue, and what it took."""
    with tempfile.TemporaryDirectory() as folder:
        sky, out = Path(folder) / "sky", Path(folder) / "out"
        toml = write_field(sky, field)[0]
        command = [sys.executable, "-m", "clresample.cli", "field", toml, "-o", out, "--quiet"]
        command += ["--workers", workers]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        with subprocess.Popen(
            [str(word) for word in command],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            memory = TreeMemory(process.pid)
            memory.start()
            said = process.communicate()[1]
        wall_s, peak = time.perf_counter() - began, memory.stop()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if process.returncode not in (0, 1):
            raise RuntimeError(said.strip() or f"exit status {process.returncode}")
        table = QTable.read(out / "catalogue.fits")
        about = json.loads((out / "provenance.json").read_text())
    core_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return table, {
        "core_s": core_s,
        "wall_s": wall_s,
        "peak_gb": (peak or after.ru_maxrss * (1 if sys.platform == "darwin" else 1024)) / 1e9,
        "stage": about["seconds"],
        "fits": about["fits"],
    }
