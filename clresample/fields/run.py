"""A field from mosaics to catalogue: search, link, fit, write; what is done stays done."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..sky.grid import Grid
from .blends.tiles import part_of
from .box import Box
from .hats import check_hats
from .options import FieldOptions, Progress
from .outputs import Outputs, write_outputs
from .work.fitting import Job
from .work.folder import open_folder
from .work.rounds import fitted
from .work.searching import planned


@dataclass(frozen=True, eq=False)
class FieldRun:
    """What a run has left in its folder.

    outputs: paths and numbers, see Outputs; seconds: wall time by stage
    failed: fits that were set aside; lost: {tile: why it could not be searched}
    """

    outputs: Outputs
    seconds: dict = field(default_factory=dict)
    failed: int = 0
    lost: dict = field(default_factory=dict)


def run_field(
    mosaics, folder, *, options=None, resume=False, overwrite=False, progress=None, about=None
) -> FieldRun:
    """Find, fit and measure every source of a field of mosaics.

    mosaics: sequence of Mosaic; the model's pixels are those of the one with the smallest
    folder: for catalogue.{parquet,fits,ecsv}, blends.ecsv, models.fits, model and residual mosaics,
        provenance.json; and for work/, what is done so far
    options: FieldOptions
    resume: go on where a run with the same options stopped; overwrite: forget such a run
    progress: Progress; about: dict of plain values for the provenance, such as input files

    With several workers a script must be guarded by `if __name__ == "__main__"`, as for all of
    Python's processes. Ctrl-C ends the run; what is finished stays, for `resume`.

    Raises ValueError for mosaics that do not go together, FileError for a folder with another run,
    and where nothing can be written; ImportError without sep, and without what HATS needs.
    """
    options, progress = options or FieldOptions(), progress or Progress()
    mosaics, folder = tuple(mosaics), Path(folder)
    seconds: dict[str, float] = {}
    reference = reference_of(mosaics)
    if options.hats:
        check_hats(reference)
    inputs = tuple((about or {}).get("inputs", {}).values())
    work, options = open_folder(
        folder, mosaics, reference, options, resume, overwrite, progress, inputs
    )
    whole, clock = Box.of(reference.shape), _Clock(seconds)
    core = whole if options.part is None else part_of(whole, *options.part)
    region = core if options.part is None else core.grown(options.border_px).meet(whole)
    plan = planned(mosaics, reference, region, core, work, options, progress, clock)
    job = Job(
        mosaics=mosaics,
        reference=reference,
        folder=work,
        plan=plan,
        corner=(region.y0, region.x0),
        core=core,
        settings=options.settings,
        threshold=options.threshold,
        passes=options.passes,
        memory=options.memory,
        device=options.device,
        field_number=options.field_number,
    )
    parts, unsettled = fitted(job, options, progress)
    clock.stop("fit")
    progress.stage("write", 1)
    outputs = write_outputs(folder, job, parts, unsettled, about or {}, seconds, options.hats)
    clock.stop("write")
    failed = outputs.status.get("failed", 0)
    return FieldRun(outputs, seconds, failed, plan.lost)


def reference_of(mosaics) -> Grid:
    """The grid of the mosaic with the smallest pixels, of equal ones the first.

    Raises ValueError for no mosaic, names or channels that are not unique, zero points that only
    some have, and grids of which some are flat.
    """
    if not mosaics:
        raise ValueError("mosaics is empty, at least one is needed")
    for what, names in (
        ("name", [m.name for m in mosaics]),
        ("channel", [c.name for m in mosaics for c in m.channels]),
    ):
        if len(set(names)) < len(names):
            raise ValueError(f"{what}s of mosaics must be unique, not {', '.join(names)}")
    for what, have in (
        ("zero points", [m.channels[0].zero_point is not None for m in mosaics]),
        ("a WCS", [not m.grid.is_flat for m in mosaics]),
    ):
        if len(set(have)) > 1:
            has, none = (mosaics[have.index(there)].name for there in (True, False))
            raise ValueError(f"mosaic {has!r} has {what}, {none!r} has none: give all or none")
    scales = [m.grid.pixel_scale_arcsec for m in mosaics]
    return mosaics[int(np.argmin(scales))].grid


class _Clock:
    """Wall time of stages that follow each other."""

    def __init__(self, seconds):
        self.seconds, self.since = seconds, time.perf_counter()

    def stop(self, stage):
        now = time.perf_counter()
        self.seconds[stage], self.since = now - self.since, now


def free_memory() -> int:
    """Memory [bytes] of this machine that is free; 2 GiB where it does not say."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return 2 << 30
