"""The search of a field's tiles, and the plan of its fits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np

from ...device.workers.outcome import Cause
from ...files.atomic import atomic_file
from ...sky.grid import Grid
from ..blends.link import link_footprints
from ..blends.plan import FitPlan, make_fit_plan
from ..blends.search import TileDetections, grown_footprints, place_known_sources, search_tile
from ..blends.tiles import tiles_of
from .search_setup import read_search_setup
from .tasks import TaskKind

# [bytes] Memory of a search per model pixel and channel; the total has two channels more. Measured:
# 132, 268 and 536 bytes a pixel for 1, 4 and 8 channels in the model's own pixels.
SEARCH_BYTES = 60
STEPS = 1024  # [1/px] resolution of detected positions: a hundredth of a bright source's error
LOST_RADIUS_PX = 8  # of a catalogue source's footprint on a tile whose search failed
MIN_TILE_PX = 64  # however little memory there is: smaller tiles are mostly overlap


@dataclass(frozen=True, eq=False)
class _Search:
    """Data common to all tiles of a search."""

    mosaics: tuple
    reference: Grid
    folder: Path
    threshold: float
    device: object
    positions: np.ndarray | None
    scatters: dict


def load_or_make_plan(mosaics, reference, region, core, work, options, engine, progress, clock):
    """The plan: that on disk, or a new one after the search of all tiles.

    region: Box of the model's pixels that is searched; core: Box of it whose sources are wanted
    engine: the backend that searches it
    """
    path = work / "plan.json"
    if path.exists():
        return FitPlan.from_json(path.read_text())
    n_channels = sum(len(m.channels) for m in mosaics)
    outer = int((options.group_memory / (SEARCH_BYTES * (n_channels + 2))) ** 0.5)
    size = max(MIN_TILE_PX, min(options.tile_px, outer - 2 * options.overlap_px))
    tiles = tiles_of(region, size, options.overlap_px)
    lost = _searched(mosaics, reference, tiles, work, options, engine, progress)
    clock.stop("search")

    def found(number):
        if str(number) in lost:
            return _lost(tiles[number], known_positions(options.positions, reference))
        return _read_found(work, number)

    everything = [found(tile.number) for tile in tiles]
    positions = np.concatenate([f.positions for f in everything])
    peaks = np.concatenate([f.peaks for f in everything])
    hosts = np.concatenate([f.positions if f.hosts is None else f.hosts for f in everything])
    stars = np.concatenate([_stars_of(f) for f in everything])
    del everything
    # The division into tiles changes the last digits and the order of detections. Both affect the
    # rounding of fits, which would change fluxes of some blends by two tenths of their errors.
    if options.positions is None:
        positions = np.floor(positions * STEPS) / STEPS  # not up: over the edge of the core
        hosts = np.floor(hosts * STEPS) / STEPS
    order = np.lexsort(positions.T[::-1])
    positions, peaks, hosts, stars = (a[order] for a in (positions, peaks, hosts, stars))
    footprints = link_footprints(tiles, found, region, work)
    plan = make_fit_plan(
        positions,
        peaks,
        footprints,
        region,
        limits=options.limits,
        field_number=options.field_number,
        memory=options.group_memory,
        n_channels=n_channels,
        hosts=hosts,
        stars=stars,
    )
    plan = replace(plan.restricted_to(core), failed_tiles=lost)
    if hasattr(footprints.labels, "flush"):
        footprints.labels.flush()
    with atomic_file(path) as part:
        part.write_text(plan.to_json())
    clock.stop("link")
    return plan


def _searched(mosaics, reference, tiles, work, options, engine, progress):
    """Searches the remaining tiles; returns {number: reason} of those that failed."""
    positions = known_positions(options.positions, reference)
    todo = [tile for tile in tiles if not _found_path(work, tile.number).exists()]
    progress.stage("search", len(tiles))
    progress.step(len(tiles) - len(todo))
    if not todo:
        return {}
    scatters = read_search_setup(work).scatters
    shared = _Search(mosaics, reference, work, options.threshold, None, positions, scatters)
    lost: dict[str, str] = {}
    tried: set[int] = set()

    def again(outcome):
        if outcome.cause is Cause.WORKER and outcome.task.number not in tried:
            tried.add(outcome.task.number)
            return [outcome.task]
        return None

    for outcome in engine.run(SEARCH, shared, todo, again=again, stage="search"):
        if outcome.reason is not None:
            if outcome.cause is Cause.PACKAGE:
                raise ImportError(str(outcome.reason))
            lost[str(outcome.task.number)] = str(outcome.reason)
            progress.message(f"tile {outcome.task.number} is lost: {outcome.reason}")
        progress.step(1, outcome.value or 0)
    return lost


def known_positions(positions, reference):
    """Positions (S, 2) [px] in the reference's pixels of a catalogue's (S, 2) [deg], or None."""
    if positions is None:
        return None
    return reference.pixel(*np.asarray(positions, float).reshape(-1, 2).T)


def _lost(tile, positions):
    """Detections of a tile whose search failed: the sources of a catalogue, and no others.

    They are fitted on discs.
    """
    light, lit = np.zeros(tile.core.shape), np.zeros(tile.core.shape, bool)
    if positions is None or not (own := tile.core.contains(positions)).any():
        return TileDetections(np.zeros((0, 2)), np.zeros(0), light, lit)
    lit = grown_footprints(lit, positions[own] - np.array(tile.core[:2]), LOST_RADIUS_PX)
    return TileDetections(positions[own], np.zeros(own.sum()), light, lit)


def _stars_of(found):
    """`TileDetections.stars`, (S,) bool."""
    return np.zeros(len(found.positions), bool) if found.stars is None else found.stars


def _found_path(work, number):
    return work / f"tile-{number:05d}.npz"


def _nothing(shared, tile):
    """Inputs of the search of a tile from the run's folder: none."""


def _search_tile(shared, tile, given):
    """Searches one tile: (number of sources, detections as bytes)."""
    known = shared.mosaics, shared.reference, tile
    if shared.positions is None:
        found = search_tile(*known, threshold=shared.threshold, scatters=shared.scatters)
    else:
        found = place_known_sources(*known, shared.positions, scatters=shared.scatters)
    file = BytesIO()
    np.savez(
        file,
        positions=found.positions,
        peaks=found.peaks,
        light=found.snr_map,
        hosts=found.positions if found.hosts is None else found.hosts,
        stars=_stars_of(found),
        lit=np.packbits(found.footprint_mask),
    )
    return len(found.positions), file.getvalue()


def _tile_path(shared, tile):
    return _found_path(shared.folder, tile.number)


SEARCH = TaskKind(_nothing, _search_tile, _tile_path)


def _read_found(work, number):
    with np.load(_found_path(work, number)) as file:
        light = file["light"]
        lit = np.unpackbits(file["lit"], count=light.size).reshape(light.shape).astype(bool)
        hosts, stars = file["hosts"], file["stars"]
        return TileDetections(file["positions"], file["peaks"], light, lit, hosts, stars)
