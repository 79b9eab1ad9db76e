"""Measures a device's rates: bytes copied, products and launches a second."""

from __future__ import annotations

import time

import numpy as np

from ...device.contraction import Contraction, MatrixBatch, row_stride

# (m, k, n), batch: products of a joint Euclid and Rubin fit of 118 x 118 model pixels.
SHAPES = (((118, 118, 132), 24), ((132, 118, 132), 24), ((60, 74, 80), 48), ((74, 60, 80), 48))
COPY_BYTES = 256 << 20  # larger than any cache, and copied in a fraction of a second
N_LAUNCHES = 200
# Single-precision lanes of an NVIDIA compute unit, by (major, minor) compute capability.
NVIDIA_LANES = {(7, 0): 64, (7, 5): 64, (8, 0): 64}
LANES = {"NVIDIA": 128, "AMD": 64, "ADVANCED MICRO DEVICES": 64}


def best_seconds(run, seconds, least=3):
    """The shortest of several calls of `run`, for about `seconds` [s]; the first is not counted."""
    run()
    times, end = [], time.perf_counter() + seconds
    while len(times) < least or time.perf_counter() < end:
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)


def copy_rate(device, seconds=0.3):
    """Bytes read and written in a second by copies within the device's memory."""
    n = min(COPY_BYTES, device.max_alloc, device.memory // 8) // 4
    source, target = device.zeros(n, np.float32), device.zeros(n, np.float32)

    def run():
        device.copy(source, target)
        device.finish()

    return 2 * source.nbytes / best_seconds(run, seconds)


def launch_seconds(device, seconds=0.3):
    """Seconds per launch of an almost empty kernel, in a sequence of launches."""
    y = device.zeros(16, np.float32)
    launch = device.launcher("warp.cl", "rowscale", local_size=(16, 1))
    launch.bind(n_positions=1, n_pad=16, n_bands=1, n_tables=1, y=y, y_offset=0)
    launch.bind(T=device.zeros(16, np.float32), E=y)

    def run():
        for _ in range(N_LAUNCHES):
            launch((16, 1))
        device.finish()

    return best_seconds(run, seconds) / N_LAUNCHES


class ProductTimer:
    """Products of the operator's shapes, with Tuning's tile for a device and type."""

    def __init__(self, device, dtype=np.float32, shapes=SHAPES):
        self.device, self.runs, self.kept = device, [], []
        rng, build = np.random.default_rng(0), Contraction(device, dtype)
        for (m, k, n), batch in shapes:
            a, b, c = (
                device.put(rng.standard_normal((batch, rows, columns)), dtype)
                for rows, columns in ((m, k), (k, row_stride(n)), (m, row_stride(n)))
            )
            matrices = [
                MatrixBatch(x.base_data, x.shape[2], x.shape[1] * x.shape[2]) for x in (a, b, c)
            ]
            self.runs.append((build.bind(m, n, k, *matrices), batch, 2.0 * m * n * k * batch))
            self.kept += [a, b, c]

    def __call__(self):
        """Runs every product once and waits for the device."""
        for product, batch, _ in self.runs:
            product(batch)
        self.device.finish()

    @property
    def flops(self):
        """Floating-point operations of all of them."""
        return sum(flops for _, _, flops in self.runs)

    def rate(self, seconds=0.3):
        """Floating-point operations in a second."""
        return self.flops / best_seconds(self, seconds)


def peak_flops(device):
    """Nominal single-precision operations of a GPU in a second; None for other devices.

    Units times lanes times the highest clock, two operations each: multiply and add.
    """
    if device.kind != "GPU" or device.simulated:
        return None
    vendor = device.cl.vendor.upper()
    lanes = next((n for name, n in LANES.items() if name in vendor), None)
    if lanes is None:
        return None
    if "NVIDIA" in vendor:
        capability = (
            device.cl.compute_capability_major_nv,
            device.cl.compute_capability_minor_nv,
        )
        lanes = NVIDIA_LANES.get(capability, lanes)
    return 2.0 * lanes * device.compute_units * device.cl.max_clock_frequency * 1e6
