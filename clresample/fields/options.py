"""Options of a field run and its progress callbacks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.coordinates import SkyCoord

from ..deblending.settings import FitSettings, Settings
from ..device.host import free_memory
from ..measurement.detection import THRESHOLD, check_threshold
from ..sky.validation.checks import as_real_array, check_integer
from .area import AREAS
from .blends.cut import FitLimits
from .blends.plan import LARGEST_FIELD

LOG = logging.getLogger("clresample")
# [bytes] of one group of fits: more lets more blends share a batch. By default less, the part of
# the free memory below for each worker.
MEMORY, MEMORY_PART = 1 << 30, 1 / 8
# [bytes] of a worker process: libraries, compiler and one small group take some 600 MiB
MIN_BOUND = 1 << 30
MIN_MEMORY = 1 << 26  # [bytes] what a single blend of some ten sources takes


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldOptions:
    """Options of a field run.

    settings: of the fits
    threshold [sigma]: least signal to noise of a source; passes: 1, or 2 to search each blend's
        residuals too
    positions (S, 2) [deg]: right ascension and declination (y, x [arcsec] on a flat sky) of known
        sources, or a SkyCoord of S positions; None = detect sources
    names (S,): of these sources, for the catalogue's column `name`; None = it has none
    area: sky whose sources are in the catalogue: "all", that of all mosaics; "finest", that of the
        mosaic with the smallest pixels; "auto", the first unless it has over MAX_GROWTH times as
        many model pixels. Beyond "finest", `margin_px` are searched and fitted too
    part (i, n): run only the i-th of n parts of the field (from 1), for job arrays: its catalogue
        has the sources whose centres lie in it; None = the whole field
    margin_px [model px]: width of the border around the part that is searched and fitted too.
        Blends that extend beyond the border are fitted without the sources beyond it
    tile_px [model px]: largest side of a tile of the search; overlap_px [model px]: of tiles
    limits: of one fit; larger blends are cut
    group_memory [bytes]: limit for a group of fits and for the search of a tile in a worker, and
        for each fit, besides `limits`; None = by `worker_memory`, else for groups alone, by the
        free memory: blends are not cut by it. A resumed run keeps the value of the first run
    worker_memory [bytes]: limit on the private memory of a worker process, enforced by the system
        (Linux); None = no limit. A group that exceeds it is fitted in halves, then one by one
    workers: processes; 0 = this one. task_timeout_s [s]: longest time of a group, None = no limit
    hats: write the catalogue in the HATS layout too, into DIR/hats
    device: a choice for `get_device`, or a list, with at least one worker process for each device
    scheduler: address of a `dask.distributed` scheduler, whose workers run the tasks; None =
        processes of this machine
    field_number: of the ids, 0 to 8,388,607, see `source_ids`
    """

    settings: FitSettings = Settings()
    threshold: float = THRESHOLD
    passes: int = 2
    positions: np.ndarray | None = None
    names: Sequence[str] | None = None
    area: str = "auto"
    part: tuple[int, int] | None = None
    margin_px: int = 256
    tile_px: int = 1024
    overlap_px: int = 96
    limits: FitLimits = FitLimits()
    group_memory: int | None = None
    worker_memory: int | None = None
    workers: int = 0
    task_timeout_s: float | None = None
    hats: bool = False
    device: object = None
    scheduler: str | None = None
    field_number: int = 0

    def __post_init__(self):
        n = _n_positions(self.positions)
        if self.names is not None and len(self.names) != n:
            raise ValueError(
                f"names has {len(self.names)} names, must have one for each of {n} positions"
            )
        if self.passes not in (1, 2):
            raise ValueError(f"passes is {self.passes}, must be 1 or 2")
        check_threshold(self.threshold)
        for name, least in (("tile_px", 1), ("overlap_px", 0), ("margin_px", 0)):
            check_integer(name, getattr(self, name), least)
        if self.overlap_px >= self.tile_px:
            raise ValueError(
                f"overlap_px is {self.overlap_px}, must be below tile_px, {self.tile_px}: use for "
                "example a tenth of it"
            )
        if self.area not in AREAS:
            raise ValueError(f"area is {self.area!r}, must be {', '.join(map(repr, AREAS))}")
        if not 0 <= self.field_number <= LARGEST_FIELD:
            raise ValueError(f"field_number is {self.field_number}, must be 0 to {LARGEST_FIELD}")
        if self.workers < 0:
            raise ValueError(f"workers is {self.workers}, must be 0 or more")
        if self.group_memory is not None and not self.group_memory >= MIN_MEMORY:
            raise ValueError(f"group_memory is {self.group_memory} bytes, must be 64 MiB or more")
        if self.worker_memory is not None and not self.worker_memory >= MIN_BOUND:
            raise ValueError(f"worker_memory is {self.worker_memory} bytes, must be 1 GiB or more")
        if isinstance(self.device, (list, tuple)) and not self.device:
            raise ValueError("device is an empty list, must name at least one")

    @property
    def devices(self) -> tuple:
        """The choices of devices; empty if there are none."""
        if isinstance(self.device, (list, tuple)):
            return tuple(self.device)
        return () if self.device is None else (self.device,)

    def with_memory(self) -> FieldOptions:
        """The same with `group_memory`, and the limit of a fit that follows from what was asked.

        Of `worker_memory` groups get half of what the libraries leave: predictions are rough, and a
        group's results need host memory in addition to the device's.
        """
        memory = self.group_memory
        if memory is None and self.worker_memory is not None:
            memory = min(MEMORY, (self.worker_memory - MIN_BOUND // 2) // 2)
        if memory is None:
            n_workers = max(self.workers, len(self.devices), 1)
            free = int(free_memory() * MEMORY_PART / n_workers)
            return replace(self, group_memory=max(MIN_MEMORY, min(MEMORY, free)))
        max_bytes = min(self.limits.max_bytes, memory)
        return replace(self, group_memory=memory, limits=replace(self.limits, max_bytes=max_bytes))


def _n_positions(positions) -> int:
    """The number of positions, 0 of None. Raises ValueError for an empty or misshapen array."""
    if positions is None:
        return 0
    is_coord = isinstance(positions, SkyCoord)
    shape = (positions.size, 2) if is_coord else as_real_array("positions", positions).shape
    if len(shape) != 2 or shape[1] != 2 or shape[0] == 0:
        raise ValueError(
            f"positions has the shape {shape}, must be (S, 2) with at least one source: give None "
            "to detect sources"
        )
    return shape[0]


@dataclass(eq=False)
class RunProgress:
    """Progress callbacks of a field run; override those you need.

    stage(name, total): a stage begins, with the number of its tiles or blends; step(n, sources): n
    of them are done; time_left(seconds): before a step, the predicted time to the end of the stage;
    message(text): a line for the user; dashboard(address): page of the workers
    """

    def stage(self, name, total):
        """A stage begins."""
        LOG.info("%s: %d to do", name, total)

    def step(self, n, sources=0):
        """Reports that n more tiles or blends of the stage are done, with so many sources."""

    def time_left(self, seconds):
        """Receives the predicted time [s] to the end of the stage, or None if it is unknown."""

    def message(self, text):
        """Receives a message for the user, one line."""
        LOG.info(text)

    def dashboard(self, address):
        """Reports the address of the page that shows the workers' tasks, if there is one."""
        self.message(f"dashboard: {address}")
