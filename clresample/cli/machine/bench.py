"""`clresample devices --bench`: what the chosen device does in a second."""

from __future__ import annotations

import time

import numpy as np

from ...device import measure
from .workload import N_SOURCES, Renders, blends, fit

N_BLENDS = 3
# [s] Of one measurement; all of them take some 5 s on a CPU that has nothing else to do.
SECONDS = 0.3


def bench_lines(device):
    """Measure one thing after the other; yields a line of text for each.

    Kernels are built before anything is timed; the first run on a machine takes longer for that.
    """
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
    fit(made[:1], device, max_iter=5)
    began = time.perf_counter()
    fit(made, device)
    rate = N_BLENDS * N_SOURCES / (time.perf_counter() - began)
    yield f"fits         {rate:.1f} sources a second, joint blends of three in four bands"


def _share(device, dtype, rate):
    """What part of the device's peak that is, where the peak is known: single precision of GPUs."""
    peak = measure.peak_flops(device) if dtype == np.float32 else None
    return f", {100 * rate / peak:.0f} % of {peak / 1e12:.1f} TFLOP/s" if peak else ""
