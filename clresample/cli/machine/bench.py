"""`clresample devices --bench`: what the chosen device does in a second."""

from __future__ import annotations

import time

import numpy as np

from . import measure
from .workload import N_SOURCES, Renders, blends, fit, iterate_once

N_BLENDS = 3  # at most
# [s] Of one measurement.
SECONDS = 0.2
# [s] Of all measurements: one blend is fitted, and more while that much time is left.
ALL_SECONDS = 8.0


def bench_lines(device):
    """Measure one thing after the other; yields a line of text for each.

    Kernels are built before anything is timed; the first run on a machine takes longer for that.
    On a device that fits slowly fewer blends are fitted, down to one.
    """
    end = time.perf_counter() + ALL_SECONDS
    yield f"copy         {measure.copy_rate(device, SECONDS) / 1e9:.1f} GB/s read and written"
    yield f"launch       {measure.launch_seconds(device, SECONDS) * 1e6:.1f} us"
    for dtype in (np.float32, np.float64):
        if dtype == np.float32 or device.has_fp64:
            rate = measure.Products(device, dtype).rate(SECONDS)
            share = _share(device, dtype, rate)
            yield f"contraction  {rate / 1e9:.0f} GFLOP/s {dtype.__name__}{share}"
    rate = Renders(device).rate(SECONDS)
    yield f"renders      {rate:.0f} a second, 100 x 100 Euclid pixels to Rubin's, float32"
    made = blends(N_BLENDS, device)
    iterate_once(made[0], device)
    seconds, n = _fit_seconds(made[:1], device), 1
    more = min(N_BLENDS, int((end - time.perf_counter()) / seconds))
    if more > 1:
        seconds, n = _fit_seconds(made[:more], device), more
    rate = n * N_SOURCES / seconds
    yield f"fits         {rate:.1f} sources a second, {n} joint blends of three in four bands"


def _fit_seconds(given, device):
    began = time.perf_counter()
    fit(given, device)
    return time.perf_counter() - began


def _share(device, dtype, rate):
    """What part of the device's peak that is, where the peak is known: single precision of GPUs."""
    peak = measure.peak_flops(device) if dtype == np.float32 else None
    return f", {100 * rate / peak:.0f} % of {peak / 1e12:.1f} TFLOP/s" if peak else ""
