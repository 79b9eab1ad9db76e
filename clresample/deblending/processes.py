"""Processes that share the cores of a CPU between the blends of one call.

Most of a fit's time is Python's, of which a process runs one thread at a time, and launches on the
small images of a blend gain little from further cores. On two cores two processes take 0.66 of the
time of one for 128 joint scenes, their start included, and 0.73 for 32.
"""

from __future__ import annotations

import io
import multiprocessing
import pickle

import numpy as np

from ..device.multi_device import n_beside

# Least number of sources for each process, which takes 2 s to start; a source takes some 0.08 s.
MIN_SOURCES = 50
# Largest number of blends that a process is sent at a time: a group of fits on CPUs.
MAX_BLENDS = 32


def n_processes(blends, device, settings) -> int:
    """Number of processes that fit blends on a device in the shortest time; 1 = the present one.

    That is 1 for GPUs, for few sources, in a process that another one has started by
    `multiprocessing`, and for blends or FitSettings that need the caller's script (PSFs by
    functions of it, constraints by its classes).
    """
    n = min(len(blends), _n_sources(blends) // MIN_SOURCES)
    if n < 2 or multiprocessing.parent_process() is not None:
        return 1
    n = min(n, n_beside(device.cl))
    return n if n > 1 and can_be_sent((blends, settings)) else 1


def can_be_sent(objects) -> bool:
    """True if another process can read objects without the caller's script."""
    written = io.BytesIO()
    try:
        _WithoutArrays(written).dump(objects)
    except Exception:  # whatever an object of the caller's raises
        return False
    return b"__main__" not in written.getvalue()


def _n_sources(blends):
    """Number of sources of all blends; 0 if one is invalid, which a fit finds."""
    try:
        return sum(len(blend.sources) for blend in blends)
    except (AttributeError, TypeError):
        return 0


class _WithoutArrays(pickle.Pickler):
    """Pickles everything but the contents of arrays."""

    def persistent_id(self, value):
        """A name for an array of numbers."""
        return "array" if type(value) is np.ndarray and not value.dtype.hasobject else None
