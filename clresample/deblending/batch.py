"""Joint deblending: one scene fitted to all instruments' images, one blend or thousands."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from ..device.device import get_device
from ..device.discovery import DeviceError
from .blend import INTERRUPTED, Blend, Failure
from .fit import Fit
from .iterate import iterate
from .result import Result
from .settings import Settings

# Ragged batches: frames and observations are padded to multiples of this [px].
PAD_PX = 16
# Device memory of one group of scenes [bytes], unless told otherwise.
MEMORY = 1 << 30
# What can go wrong with one blend and is no reason to give up the others.
ERRORS = (ValueError, ArithmeticError, DeviceError, MemoryError, np.linalg.LinAlgError)
# Scenes fitted side by side: enough to hide the launches, few enough for a CPU's cache.
SCENES = {"CPU": 32}
SCENES_ELSEWHERE = 1024


def deblend(
    observations,
    sources,
    *,
    frame=None,
    shifts=None,
    settings=None,
    device=None,
    dtype=np.float32,
    progress=None,
) -> Result:
    """Fit one scene to all observations at once.

        min 1/2 sum_o |sqrt(w_o) (R_o sum_s A_s S_s - d_o)|^2 + 1/2 |z|^2,  A >= 0, S constrained

    observations, sources, frame, shifts: see Blend; settings: see Settings
    progress: called every few iterations with their number so far and the loss (1,)
    raises ValueError for what `check_observations`, `model_frame` and `Source` refuse, and when no
    source lies inside the frame. Ctrl-C ends the fit with the best state so far.
    """
    blend = Blend(tuple(observations), tuple(sources), frame, shifts)
    settings = settings or Settings()
    device = get_device(device)
    fit = Fit(blend, settings, device, dtype, pad=1)
    (done,) = iterate([fit], settings, device, dtype, progress)
    return done.result()


def deblend_many(
    blends, *, settings=None, device=None, dtype=np.float32, memory=MEMORY, progress=None
) -> list[Result | Failure]:
    """Fit many blends side by side; each comes out as if it were fitted alone, to float accuracy.

    blends: Blend, with sizes, sources, PSFs, WCS and instruments of their own
    memory [bytes]: of the device for one group of scenes
    progress: called with the number of blends done, after each group and each failure
    returns a Result for each blend, in their order, or a Failure: it does not harm the others.
        Ctrl-C ends the fits of the group that runs with the best state so far; what was done before
        comes back, and Failures with the status "interrupted" for the rest
    """
    settings, device = settings or Settings(), get_device(device)
    blends = list(blends)
    out: list[Result | Failure | None] = [None] * len(blends)
    pad = PAD_PX if len({_sizes(b) for b in blends}) > 1 else 1
    limit = SCENES.get(device.kind, SCENES_ELSEWHERE)
    waiting = defaultdict(list)
    n_done = 0

    def count(n):
        nonlocal n_done
        n_done += n
        if progress is not None:
            progress(n_done)

    def run(group):
        for i, done in _try(group, settings, device, dtype):
            out[i] = done
        count(len(group))
        if any(fit.status == INTERRUPTED for _, fit in group):
            raise KeyboardInterrupt

    try:
        for i, blend in enumerate(blends):
            try:
                fit = Fit(blend, settings, device, dtype, pad=pad)
            except ERRORS as error:
                out[i] = Failure(blend, f"failed: {error}")
                count(1)
                continue
            group = waiting[fit.problem.signature]
            group.append((i, fit))
            if len(group) >= limit or sum(f.bytes for _, f in group) + fit.bytes > memory:
                run(waiting.pop(fit.problem.signature))
        while waiting:
            run(waiting.popitem()[1])
    except KeyboardInterrupt:
        pass  # those without a result are told so
    return [
        Failure(blend, INTERRUPTED) if done is None else done
        for blend, done in zip(blends, out, strict=True)
    ]


def _try(group, settings, device, dtype):
    """Yield (index, Result or Failure) of a group of fits; one by one where all at once fails."""
    try:
        iterate([fit for _, fit in group], settings, device, dtype)
    except ERRORS as error:
        if len(group) == 1:
            yield group[0][0], Failure(group[0][1].blend, f"failed: {error}")
            return
        for item in group:
            yield from _try([item], settings, device, dtype)
            if item[1].status == INTERRUPTED:
                return
        return
    for i, fit in group:
        try:
            yield i, fit.result()
        except ERRORS as error:
            yield i, Failure(fit.blend, f"failed: {error}")


def _sizes(blend):
    return tuple(o.data.shape for o in blend.observations), blend.frame and blend.frame.shape
