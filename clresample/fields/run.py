"""Runs a field from mosaics to catalogue: search, link, fit, write; a run resumes."""

from __future__ import annotations

import pickle
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord

from ..deblending.ended import Ended
from ..deblending.settings import AUTO, SMALL
from ..sky.validation.checks import check_instance, check_sequence
from ..sky.wcs import celestial_frame
from .area import check_listed, field_area
from .blends.tiles import field_part
from .execution.backend import make_backend
from .execution.fitting import FieldJob
from .execution.folder import open_folder
from .execution.rounds import fit_all_groups
from .execution.search_setup import prepare_search, read_search_setup
from .execution.searching import known_positions, load_or_make_plan
from .hats import check_hats
from .mosaic import Mosaic
from .options import MIN_MEMORY, FieldOptions, RunProgress
from .outputs import FieldOutputs, check_outputs, write_outputs
from .reference import reference_grid as reference_grid
from .sky_level import measured_sky, sky_notes, without_sky
from .strips import STRIPS


@dataclass(frozen=True, eq=False)
class FieldRun:
    """Results of a run in its folder.

    outputs: paths and numbers, see FieldOutputs; seconds: wall time by stage
    failed: fits that were set aside; failed_tiles: {tile: reason of the failed search}
    task_times: (stage, Outcome) of every finished task, with its worker and times
    """

    outputs: FieldOutputs
    seconds: dict = field(default_factory=dict)
    failed: int = 0
    failed_tiles: dict = field(default_factory=dict)
    task_times: tuple = ()


def run_field(
    mosaics, folder, *, options=None, resume=False, overwrite=False, progress=None, about=None
) -> FieldRun:
    """Finds, fits and measures every source of a field of mosaics.

    mosaics: sequence of Mosaic; the model's pixels are those of the one with the smallest
    folder: for catalogue.{parquet,fits,ecsv}, fit_table.ecsv, models.fits, model and residual
        mosaics, provenance.json; and for work/, what is done so far
    options: FieldOptions
    resume: go on where a run with the same options stopped; overwrite: forget such a run
    progress: RunProgress; about: dict of plain values for the provenance, such as input files

    With several workers a script must be guarded by `if __name__ == "__main__"`, as for all of
    Python's processes. Ctrl-C ends the run; what is finished stays, for `resume`.

    Raises ValueError for mosaics that do not go together, FileError for a folder with another run,
    and where nothing can be written; ImportError without sep, and without what HATS needs.
    """
    options, progress = options or FieldOptions(), progress or RunProgress()
    check_instance("options", options, FieldOptions)
    mosaics, folder = _as_sent(check_sequence("mosaics", mosaics, Mosaic)), Path(folder)
    seconds: dict[str, float] = {}
    reference = reference_grid(mosaics)
    options = replace(options.with_memory(), positions=_degrees(options.positions, reference))
    _check_outputs(folder, mosaics, reference, options)
    inputs = tuple((about or {}).get("inputs", {}).values())
    known = known_positions(options.positions, reference)
    wanted, searchable, notes = field_area(mosaics, reference, options.area, known)
    if known is not None:
        check_listed(options.positions, reference, wanted)
    work, options = open_folder(
        folder, mosaics, reference, options, resume, overwrite, progress, inputs
    )
    clock, settings = _Clock(seconds), options.settings
    if settings.fit_sky == AUTO:
        found = measured_sky(mosaics, work)
        lowered = sky_notes(mosaics, found)
        notes += tuple(lowered)
        mosaics = without_sky(mosaics, {name: level for name, (level, _) in found.items()})
        measured = all(c.name in found for m in mosaics for c in m.channels)
        settings = replace(settings, fit_sky=SMALL if lowered and measured else AUTO)
    core = wanted if options.part is None else field_part(wanted, *options.part)
    region = core.grown(options.margin_px).intersection(searchable)
    engine = make_backend(options, progress)
    try:
        prepare_search(mosaics, reference, work, engine)
        memory = max(MIN_MEMORY, min(options.group_memory, read_search_setup(work).memory))
        options = replace(options, group_memory=_power_of_two(memory))
        plan = load_or_make_plan(
            mosaics, reference, region, core, work, options, engine, progress, clock
        )
        names = _names_by_id(plan, options.names, known)
        job = FieldJob(
            mosaics=mosaics,
            reference=reference,
            folder=work,
            plan=plan,
            origin_px=(region.y0, region.x0),
            core=core,
            is_part=core != wanted,
            settings=settings,
            threshold=options.threshold,
            passes=options.passes,
            memory=options.group_memory,
            field_number=options.field_number,
        )
        parts, unsettled = fit_all_groups(job, engine, progress)
        engine.close()  # frees its memory for the outputs
        clock.stop("fit")
        progress.stage("write", 1)
        outputs = write_outputs(
            folder, job, parts, unsettled, about or {}, seconds, options.hats, notes, names
        )
    finally:
        engine.close()
        STRIPS.clear()
    clock.stop("write")
    failed = outputs.status.get(Ended.FAILED, 0)
    return FieldRun(outputs, seconds, failed, plan.failed_tiles, tuple(engine.turns))


def _names_by_id(plan, names, positions):
    """Names {id: name} of the listed sources at positions (S, 2) [model px]; None without names.

    A plan has those in its region, without those of tiles that failed, in another order.
    """
    if names is None:
        return None
    names_at: dict[tuple, list[str]] = {}
    for place, name in zip(positions.tolist(), names, strict=True):
        names_at.setdefault(tuple(place), []).append(str(name))
    pairs = zip(plan.ids.tolist(), plan.positions.tolist(), strict=True)
    return {one: names_at[tuple(place)].pop(0) for one, place in pairs}


def _degrees(positions, reference):
    """Positions (S, 2) [deg] in the frame of the reference's WCS.

    A SkyCoord is transformed to it; other positions are returned unchanged.
    Raises ValueError for a SkyCoord on a flat sky.
    """
    if not isinstance(positions, SkyCoord):
        return positions
    if reference.is_flat:
        raise ValueError(
            "positions is a SkyCoord, but the mosaics are flat: give (y, x) [arcsec], or the "
            "mosaics a WCS"
        )
    sky = positions.ravel().transform_to(celestial_frame(reference.wcs)).spherical
    return np.stack([sky.lon.deg, sky.lat.deg], axis=1)


def _check_outputs(folder, mosaics, reference, options):
    """Raises ValueError, FileError or ImportError, at the start, for unwritable outputs."""
    if options.hats:
        check_hats(reference)
    check_outputs(folder, mosaics)


def _as_sent(mosaics):
    """The mosaics with their grids as another process gets them.

    A WCS is sent as a header, with rounded numbers, which changes fluxes by 1e-5. This process,
    which may run fits too, uses the same rounded WCS, so that results do not depend on the workers.
    """
    return tuple(replace(m, grid=pickle.loads(pickle.dumps(m.grid))) for m in mosaics)


class _Clock:
    """Wall time of stages that follow each other."""

    def __init__(self, seconds):
        self.seconds, self.since = seconds, time.perf_counter()

    def stop(self, stage):
        now = time.perf_counter()
        self.seconds[stage], self.since = now - self.since, now


def _power_of_two(n) -> int:
    """The largest power of two up to n: groups are alike where the free memory is nearly so."""
    return 1 << (int(n).bit_length() - 1)
