"""Sizes of kernels that differ among vendors of GPUs; `make gpu-builds` shows what they take.

They follow from the compilers' reports: no float32 build spills registers, and enough waves run
side by side to hide the latency of memory. With all of them sums have the same order.
"""

from __future__ import annotations

import numpy as np

# How the drivers of each vendor begin its name.
VENDORS = {
    "Advanced Micro Devices": "AMD",
    "AMD": "AMD",
    "Intel": "Intel",
    "NVIDIA": "NVIDIA",
}


def gpu_vendor(name):
    """Vendor by a driver's name for it: "AMD" or "Intel"; "NVIDIA" also for all others."""
    return next((v for begin, v in VENDORS.items() if name.startswith(begin)), "NVIDIA")


def gpu_sizes(vendor, dtype=np.float32) -> dict:
    """Fields of Tuning for GPUs of "AMD", "Intel" or "NVIDIA" and float32 or float64."""
    double = np.dtype(dtype) == np.float64
    vector = 2 if double else 4  # 16-byte loads
    tile = {"VW": vector, "NV": 1, "MR": 4, "WGX": 16, "WGY": 16, "KB": 16}
    boxes = {"VW": vector, "NV": 1, "MR": 8, "WGX": 16, "WGY": 4}
    rows: tuple[int, ...]
    if vendor == "AMD":
        # a group of 64 is one wave with 15 KB of local memory, of which a SIMD then holds one
        rows, two_sum_rows, lanes = (2, 4) if double else (2, 4, 6), 6, 8
    elif vendor == "Intel":
        # of a thread's 128 registers 32 lanes with 8 sums each take a quarter
        tile |= {"VW": 2, "MR": 2 if double else 4}
        boxes |= {"VW": 2, "MR": 2, "KU": 1 if double else 2}
        rows, two_sum_rows, lanes = (2,) if double else (2, 4), 2, 4
    else:
        # a square of 64 work-items that every GPU allows: 64 x 64 floats of the product, and two
        # slabs of 8 KiB in local memory; 48, 64 or 80 rows, more spill
        tile |= {"NV": 2, "MR": 8, "WGX": 8, "WGY": 8}
        rows, two_sum_rows, lanes = ((6, 8), 6, 8) if double else ((6, 8, 10), 8, 8)
    return {
        "tile": tile,
        "row_choices": rows,
        "two_sum_rows": two_sum_rows,
        "box_tile": boxes,
        "lanes": lanes,
    }
