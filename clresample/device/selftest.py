"""Compares a small render on a device with NumPy's, to detect drivers that compute wrongly.

    Y = Re[ Sy (D o (Ty X Tx)) Sx ]     by the kernels of aligned operators on that device

A render of random numbers passes every step of an aligned operator: products of cos and sin
waves, the transfer function, and rows that are stored one element at a time.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress

import numpy as np

from .contraction import FILE, GROUP_FILE, MatrixBatch, row_stride
from .mirror_contraction import BACK_FILE, FILE as WAVES_FILE, fourier_contraction
from .program import read_kernel

# [1] Largest relative error, L2. In float32 a correct device has 1e-7. A driver that computes in
# half precision or loses a row has 1e-3 and more.
ALLOWED = 1e-5
PART = "self_test"
# Rows and columns of the model and of the observation, and frequencies of either axis. None is a
# multiple of a tile, so that partial tiles are tested too.
N_Y, N_X, M_Y, M_X, H_Y, H_X = 19, 21, 11, 13, 9, 10


def self_test_fault(device, remembered):
    """Reason not to use `device`, or None.

    remembered: the DeviceCache of the device; a test that was passed is stored there, not repeated
    """
    if has_passed(remembered):
        return None
    found, truth = render(device), reference()
    error = np.linalg.norm(found - truth) / np.linalg.norm(truth)
    if not error <= ALLOWED:  # NaN is a fault as well
        return (
            f"{device.name} ({device.platform}) fails its self-test: a small render is off by "
            f"{error:.1g}, where {ALLOWED:g} is allowed"
        )
    with suppress(OSError):  # the next process repeats the test, which takes some milliseconds
        remembered.write(PART, _kernels())
    return None


def has_passed(remembered):
    """Returns True if a device has passed the test with the present kernels."""
    return remembered.read(PART) == _kernels()


def _kernels():
    files = FILE, GROUP_FILE, WAVES_FILE, BACK_FILE
    return hashlib.sha256("".join(map(read_kernel, files)).encode()).hexdigest()


def _given():
    """The model, the waves of the four sides, and the transfer functions at (+, +) and (+, -)."""
    rng = np.random.default_rng(20260101)
    waves = [
        np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(2 * h, n)
        for h, n in ((H_Y, N_Y), (H_X, N_X), (H_Y, M_Y), (H_X, M_X))
        for angle in [np.pi * rng.uniform(-1, 1, (h, 1)) * (np.arange(n) - n // 2)]
    ]
    d = rng.normal(size=(2, H_Y, H_X)) + 1j * rng.normal(size=(2, H_Y, H_X))
    return rng.normal(size=(N_Y, N_X)), *waves, d


def reference():
    """The render in float64 by complex arithmetic, term by term from the formula."""
    x, ty, tx, sy, sx, d = _given()
    total = np.zeros((M_Y, M_X))
    for sign, of_sign in zip((1, -1), d, strict=True):
        in_y, out_y = (t[0::2] + 1j * t[1::2] for t in (ty, sy))
        in_x, out_x = (t[0::2] + sign * 1j * t[1::2] for t in (tx, sx))
        found = of_sign * (in_y.conj() @ x @ in_x.conj().T)
        total += (out_y.T @ found @ out_x).real
    return total


def render(device):
    """The same on the device in float32 (M_Y, M_X)."""
    x, ty, tx, sy, sx, d = _given()
    dtype, k_x = np.float32, 2 * H_X

    def put(values):
        wide = np.zeros((len(values), row_stride(values.shape[1])))
        wide[:, : values.shape[1]] = values
        return device.put(wide, dtype)

    planes = np.zeros((H_Y, 4, row_stride(k_x) // 2))
    planes[:, :, :H_X] = np.stack([d[0].real, d[0].imag, d[1].real, d[1].imag], axis=1)
    model, left, right = device.put(x, dtype), device.put(ty, dtype), put(tx.T)
    out_y, out_x, transfer = device.put(sy.T, dtype), put(sx), device.put(planes, dtype)
    half, z, lines = (device.empty((n, row_stride(k_x)), dtype) for n in (N_Y, 2 * H_Y, M_Y))
    image = device.empty((M_Y, M_X), dtype)

    def matrix(array):
        return MatrixBatch(array.base_data, array.shape[1])

    def product(side, **options):
        return fourier_contraction(device, dtype, side, **options).bind

    d = transfer.base_data, 0, 0
    product("right")(N_Y, k_x, N_X, matrix(model), matrix(right), matrix(half))(1)
    to_frequencies = product("left", epilogue="MIX")
    to_frequencies(2 * H_Y, k_x, N_Y, matrix(left), matrix(half), matrix(z), d)(1)
    product("left", back=True)(M_Y, k_x, 2 * H_Y, matrix(out_y), matrix(z), matrix(lines))(1)
    to_pixels = product("right", back=True, ragged=True)
    to_pixels(M_Y, M_X, k_x, matrix(lines), matrix(out_x), matrix(image))(1)
    return device.get(image)
