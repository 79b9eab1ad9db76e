"""A store of plans and operators: one of equal geometry and PSFs is made once and used again."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict

import numpy as np

from ..device.device import get_device
from ..sky.frame import Frame
from ..sky.grid import Grid
from ..sky.psf import PSF
from .plan import Precision, make_resampling_plan
from .resampler import Resampler

# [bytes] For blends of 50 to 200 pixels, plans take 0.1 to 4 MB each and operators twice that. This
# stores hundreds, those of the epochs and bands of one survey tile. With less memory, fits compute
# them again (10 to 100 ms each); more memory would hold entries that are never used again.
PLAN_BYTES, DEVICE_BYTES = 512 << 20, 256 << 20
# Sizes of all entries are measured again when this fraction of them is new. A tenth costs ten
# measurements for each new entry; with a larger fraction, growth is noticed later.
GROWTH = 0.1


class _LRUStore:
    """Entries by their keys; the least recently used are dropped beyond `most` bytes.

    Entries grow while they are used. Measuring hundreds of entries for each new one takes longer
    than making it, so sizes are measured only when the fraction GROWTH of the entries is new.
    """

    def __init__(self, most):
        self.most, self._entries = most, OrderedDict()
        self._held, self._n_new = {}, 0

    def __len__(self):
        return len(self._entries)

    def clear(self):
        """Empties the cache."""
        self._entries.clear()
        self._held.clear()

    def find(self, key, make):
        """The entry of a key, made by `make()` if there is none."""
        if key not in self._entries:
            self._entries[key] = make()
            self._held[key] = self._entries[key].n_bytes
            self._n_new += 1
            if self._n_new > GROWTH * len(self._entries):
                self._held = {k: entry.n_bytes for k, entry in self._entries.items()}
                self._n_new = 0
            self._drop()
        self._entries.move_to_end(key)
        return self._entries[key]

    def _drop(self):
        held = sum(self._held.values())
        while held > self.most and len(self._entries) > 1:
            oldest, _ = self._entries.popitem(last=False)
            held -= self._held.pop(oldest)


class OperatorCache:
    """Resamplers by their grids and PSFs, with their plans, bounded in bytes.

    plan_bytes [bytes]: host memory that plans may hold
    device_bytes [bytes]: limit on the device memory of operators, with the intermediates of their
        last batch. The least recently used operator is dropped first; the newest always stays

    Safe to share between threads, as the operators are.
    """

    def __init__(self, *, plan_bytes=PLAN_BYTES, device_bytes=DEVICE_BYTES):
        self.plan_bytes, self.device_bytes = plan_bytes, device_bytes
        self._plans, self._operators = _LRUStore(plan_bytes), _LRUStore(device_bytes)
        self._lock = threading.RLock()

    def resampler(
        self,
        frame: Frame,
        grid: Grid,
        psf: PSF,
        *,
        dtype,
        device=None,
        extent=None,
        private=False,
        n_terms=1,
    ) -> Resampler:
        """The Resampler from `frame` to `grid` and `psf`; repeated calls return the same object.

        extent (2,) [px]: part of the frame that can have light, the rest being padding; None = all
        private: True = an operator for this caller alone, whose shift may be set, on the same plan
        n_terms: PSFs that psf has in turn for each band, see ResamplingPlan

        Raises ValueError as Resampler does.
        """
        device, dtype = get_device(device), np.dtype(dtype)
        mapping = grid.map_to(frame.grid)
        key = n_terms, _key(mapping, frame.psf, psf, dtype, extent)

        def plan():
            precision = Precision.of(dtype)
            return make_resampling_plan(
                mapping, frame.psf, psf, precision=precision, extent=extent, n_terms=n_terms
            )

        def operator():
            plans = [self._plans.find(key, plan)]
            return Resampler.from_plans(plans, dtype=dtype, device=device)

        with self._lock:
            if private:
                return operator()
            shared = self._operators.find((key, device), operator)
            shared.is_shared = True
            return shared

    @property
    def n_plans(self) -> int:
        """Number of plans held."""
        return len(self._plans)

    @property
    def n_operators(self) -> int:
        """Number of operators held."""
        return len(self._operators)

    def clear(self):
        """Drops all plans and operators; those in use elsewhere remain valid."""
        with self._lock:
            self._plans.clear()
            self._operators.clear()


@functools.cache
def default_cache() -> OperatorCache:
    """The default cache."""
    return OperatorCache()


def cached_resampler(
    frame: Frame,
    grid: Grid,
    psf: PSF,
    *,
    dtype,
    device=None,
    extent=None,
    private=False,
    n_terms=1,
    cache: OperatorCache | None = None,
) -> Resampler:
    """`OperatorCache.resampler` of a cache, or of the default one."""
    cache = default_cache() if cache is None else cache
    return cache.resampler(
        frame,
        grid,
        psf,
        dtype=dtype,
        device=device,
        extent=extent,
        private=private,
        n_terms=n_terms,
    )


def _key(mapping, psf_in, psf_out, dtype, extent):
    """Key of a plan: equal for equal bytes."""
    digest = hashlib.sha256()
    parts = [mapping.matrix, mapping.offset, mapping.positions, mapping.area]
    for psf in (psf_in, psf_out):
        parts += [psf.images, psf.center, np.float64(psf.spacing)]
    for part in parts:
        digest.update(b"-" if part is None else np.ascontiguousarray(part).tobytes())
    return (
        mapping.geometry,
        mapping.shape_in,
        mapping.shape_out,
        None if extent is None else tuple(extent),
        dtype.str,
        tuple(psf.images.shape for psf in (psf_in, psf_out)),
        digest.digest(),
    )
