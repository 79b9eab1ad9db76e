"""Measures once per run the noise scatter of each mosaic and the device memory of a group."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ...device.device import get_device
from ...device.workers.outcome import Cause
from ...files.atomic import FileError
from ...sky.grid import Grid
from ..blends.search import snr_scatter
from .tasks import TaskKind

# Largest fraction of a device's memory that a group of fits may take by prediction: predictions are
# rough, and the driver, its kernels and the next group's data need memory too.
DEVICE_PART = 4
FILE = "search_setup.json"


@dataclass(frozen=True)
class SearchSetup:
    """Measurements that precede the search of a run.

    scatters {mosaic's name: scatters of its signal to noise}: see `snr_scatter`
    devices: names of the requested ones; memory [bytes]: of the smallest, for one group
    """

    scatters: dict
    devices: list
    memory: int


@dataclass(frozen=True, eq=False)
class _Field:
    mosaics: tuple
    reference: Grid
    folder: Path
    device: object = None


def prepare_search(mosaics, reference, work, engine):
    """Measures the search setup of a field, once per run. Raises ImportError without sep."""
    if (work / FILE).exists():
        return
    tried: list = []

    def again(outcome):
        tried.append(outcome)
        return [outcome.task] if outcome.cause is Cause.WORKER and len(tried) < 2 else None

    engine.begin(PREPARE)  # one worker measures while the others load their modules
    field = _Field(mosaics, reference, work)
    for outcome in engine.run(PREPARE, field, [engine.device_shares], again=again, stage="search"):
        if outcome.reason is not None:
            if outcome.cause is Cause.PACKAGE:
                raise ImportError(str(outcome.reason))
            raise FileError(f"{work.parent}: nothing can be searched ({outcome.reason})")


def read_search_setup(work) -> SearchSetup:
    """Reads the setup that was measured."""
    return SearchSetup(**json.loads((work / FILE).read_text()))


def _given(field, sharing):
    """Inputs from the run's folder: none."""


def _look(field, sharing, given):
    """sharing: [(choice of a device, number of its workers)]; None is the worker's own."""
    devices = [(get_device(field.device if choice is None else choice), n) for choice, n in sharing]
    scatters = snr_scatter(field.mosaics, field.reference)
    look = SearchSetup(
        {name: np.asarray(scatter).tolist() for name, scatter in scatters.items()},
        [device.name for device, _ in devices],
        min(device.memory // (DEVICE_PART * n) for device, n in devices),
    )
    return None, json.dumps(asdict(look), indent=1).encode()


def _path(field, sharing):
    return field.folder / FILE


PREPARE = TaskKind(_given, _look, _path)
