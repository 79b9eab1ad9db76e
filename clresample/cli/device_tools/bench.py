"""`clresample devices --bench`: work of the chosen device in a second."""

from __future__ import annotations

import time

import numpy as np

from ...device.tuning import Tuning
from . import measure
from .workload import N_SOURCES, RenderWorkload, blends, fit, iterate_once

N_FEW = 3  # blends, fitted after a first one
GROWTH = 8  # largest ratio of blends to those of the step before
N_DIFFERENT = 32  # different blends; larger numbers repeat them
# [s] Of one measurement.
SECONDS = 0.2
# [s] Of all measurements: one blend is fitted, and more while that much time is left.
ALL_SECONDS = 8.0


def bench_lines(device):
    """Measures one thing after the other; yields a line of text for each.

    Kernels are built before the measurements, so the first run on a machine takes longer. The
    number of blends fitted side by side is limited by the device and by the time, and at least one.
    """
    end = time.perf_counter() + ALL_SECONDS
    yield f"copy         {measure.copy_rate(device, SECONDS) / 1e9:.1f} GB/s read and written"
    yield f"launch       {measure.launch_seconds(device, SECONDS) * 1e6:.1f} us"
    for dtype in (np.float32, np.float64):
        if dtype == np.float32 or device.has_fp64:
            rate = measure.ProductTimer(device, dtype).rate(SECONDS)
            share = _share(device, dtype, rate)
            yield f"contraction  {rate / 1e9:.0f} GFLOP/s {dtype.__name__}{share}"
    rate = RenderWorkload(device).rate(SECONDS)
    yield f"renders      {rate:.0f} a second, 100 x 100 Euclid pixels to Rubin's, float32"
    made = blends(N_DIFFERENT, device)
    iterate_once(made[0], device)

    def fit_seconds(n):
        began = time.perf_counter()
        fit([made[i % len(made)] for i in range(n)], device)
        return time.perf_counter() - began

    n, seconds = largest_batch(fit_seconds, Tuning.of(device).n_scenes, end)
    rate = n * N_SOURCES / seconds
    yield (
        f"fits         {rate:.1f} sources a second; blends of {N_SOURCES} sources in four bands, "
        f"{n} at a time"
    )


def largest_batch(seconds_of, n_most, end, clock=time.perf_counter):
    """(n, seconds) of the most blends, up to `n_most`, that are fitted before `end` of `clock` [s].

    seconds_of: a function that fits n blends and returns the time it took

    Fits one blend, then a few, then more as long as at least twice as many are expected to end in
    time. The cost of a further blend is estimated from the last two steps. The first fit is often
    slower than others, so it limits the second step only. If the estimate is not available, or is
    negative because of noise, the mean cost of the last step is used.
    """
    fitted = [(1, seconds_of(1))]
    n, seconds = fitted[0]
    more = min(N_FEW, n_most, int((end - clock()) / seconds))
    while more > n and (more >= 2 * n or more == n_most):
        fitted.append((more, seconds_of(more)))
        (n_before, before), (n, seconds) = fitted[-2:]
        each = seconds / n
        if len(fitted) > 2 and seconds > before:
            # one step may not be wrong by more than the growth allows
            each = max((seconds - before) / (n - n_before), each / GROWTH)
        more = min(n_most, GROWTH * n, n + int((end - clock() - seconds) / each))
    return n, seconds


def _share(device, dtype, rate):
    """Fraction of the device's peak, where the peak is known: single precision of GPUs."""
    peak = measure.peak_flops(device) if dtype == np.float32 else None
    return f", {100 * rate / peak:.0f} % of {peak / 1e12:.1f} TFLOP/s" if peak else ""
