"""Tables of the paper's scheme: waves in float64 on the host, matrices on the device."""

from __future__ import annotations

import numpy as np

from ...device.contraction import MatrixBatch, row_stride
from ...sky.fourier import cos_sin_columns, phases


def wave_planes(k, x, n_columns):
    """exp(2 pi i nu x), nu = kappa / k: planes cos and sin (h, 2, n_columns), zero beyond len(x).

    k: length of the padded axis, which has h = (k + 1) // 2 frequencies kappa >= 0
    x [px]: displacements along that axis
    """
    angle = phases(np.arange((k + 1) // 2) / k, x)
    planes = np.zeros((len(angle), 2, n_columns))
    planes[:, 0, : len(x)], planes[:, 1, : len(x)] = np.cos(angle), np.sin(angle)
    return planes


def cos_sin_table(n, k):
    """cos and sin of 2 pi kappa x / k in columns 2 kappa, 2 kappa + 1, for x = 0 ... n - 1."""
    # whole pixels: whole cycles are taken off in integers, exactly
    return cos_sin_columns(2 * np.pi / k * (np.arange(n)[:, None] * np.arange((k + 1) // 2) % k))


def device_matrix(device, dtype, host) -> MatrixBatch:
    """A matrix, its rows padded with zeros; one for each band where `host` has three axes."""
    full = np.zeros((*host.shape[:-1], row_stride(host.shape[-1])), dtype)
    full[..., : host.shape[-1]] = host
    stride = full.shape[-2] * full.shape[-1] if host.ndim > 2 else 0
    return MatrixBatch(device.put(full).base_data, full.shape[-1], stride)


def with_transpose(device, array, n):
    """A device array (rows, n_pad) and its transpose (n, rows): either is read along its rows."""
    return array, device.put(np.ascontiguousarray(device.get(array)[:, :n].T))
