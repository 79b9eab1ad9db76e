"""Sinc interpolation on the device, and the paper's transfer function that is made with it."""

from __future__ import annotations

import math

import numpy as np

from ...device.contraction import Contraction, MatrixBatch, row_stride
from ...device.tuning import Tuning
from ...resampling.transfer import transfer_function
from ...sky.psf import PSF

# Positions at which a PSF is interpolated in one launch: three tables of 48 float64 each, 36 MiB.
POSITIONS = 1 << 15
# Relative slack on the edges of bands, above the rounding of A^T nu in float64.
BAND_SLACK = 1e-12


def sinc_table(device, positions, first, n, table, step_p, step_i):
    """Queues table[p, i] = sinc(positions[p] - first - i), i < n; see kernels/sinc.cl.

    positions (P,) [px]; table: device array, element (p, i) at p * step_p + i * step_i
    """
    whole = np.rint(positions)
    part = device.put(positions - whole, table.dtype)
    whole = device.put(whole.astype(np.int32))
    group = Tuning.of(device, table.dtype).line_group
    launch = device.launcher("sinc.cl", "sinc", dtype=table.dtype, local_size=(group, 1))
    launch(
        (n, len(positions)),
        n_integers=n,
        first=first,
        whole=whole,
        part=part,
        table=table,
        step_p=step_p,
        step_i=step_i,
    )


def interpolate_psf(device, matrix, psf: PSF, n_fft, fine=1):
    """The observed PSF on the model's pixels, in float64 where the device has it.

        P2i(x) = sum_o P2[o] sinc(q_y - o_y) sinc(q_x - o_x),    q = A^-1 x / spacing + center

    matrix (2, 2): A; n_fft (2,) [model px]: size K of the grid around x = 0
    fine: points per model pixel and axis, x = (j - n // 2) / fine for n = fine * K
    returns (C, fine Ky, fine Kx). Source: eq. `psf_interp`.
    """
    dtype = np.dtype(np.float64 if device.has_fp64 else np.float32)
    axes = [(np.arange(fine * k) - fine * k // 2) / fine for k in n_fft]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    q = x @ np.linalg.inv(matrix).T / psf.spacing
    (n_y, n_x), n_pad = psf.images.shape[1:], row_stride(psf.images.shape[2])
    along_y, group = Contraction(device, dtype), Tuning.of(device, dtype).line_group
    along_x = device.launcher("warp.cl", "rowdot", dtype=dtype, local_size=(group, 1))
    result, n_block = np.empty((psf.n_bands, len(q))), min(POSITIONS, len(q))
    rows, columns, sums, values = (
        device.zeros(shape, dtype)
        for shape in ((n_block, n_y), (n_block, n_pad), (n_block, n_pad), (n_block,))
    )
    along_x.bind(n_pad=n_pad, n=n_x, n_bands=1, n_tables=1, y=values, y_offset=0, T=sums, E=columns)
    for band, image in enumerate(psf.images):
        samples = device.put(np.pad(image, ((0, 0), (0, n_pad - n_x))), dtype)
        samples = MatrixBatch(samples.base_data, n_pad)
        for start in range(0, len(q), n_block):
            block = q[start : start + n_block] + psf.center[band]
            n = len(block)
            sinc_table(device, block[:, 0], 0, n_y, rows, n_y, 1)
            sinc_table(device, block[:, 1], 0, n_x, columns, n_pad, 1)
            tall = MatrixBatch(rows.base_data, n_y), samples, MatrixBatch(sums.base_data, n_pad)
            along_y.bind(n, n_x, n_y, *tall)(1)
            along_x((n, 1), n_positions=n)
            result[band, start : start + n] = device.get(values)[:n]
    return result.reshape(-1, *(fine * k for k in n_fft))


def sinc_transfer(device, matrix, psf_in: PSF, psf_out: PSF, n_fft):
    """D = F[P2i] / F[P1] in FFT order, floored as `transfer_function` does it.

    The transform of the sincs is a rectangle, so D is 0 beyond the observed PSF's band. Without
    this, the truncation of the sincs at the padded grid's edge would be divided by a vanishing
    F[P1]. If the band exceeds the model's Nyquist frequency, P2i is sampled on a finer grid,
    without aliases.

    matrix (2, 2): A; n_fft (2,) [model px]: K
    returns D (C, Ky, Kx) complex; max_gain, floored_power (C,) as in Certificate
    """
    reach = 0.5 / psf_out.spacing * np.abs(np.linalg.inv(matrix)).sum(axis=0).max()
    fine = max(1, math.ceil(reach + 0.5 - BAND_SLACK))
    p2 = np.fft.ifftshift(interpolate_psf(device, matrix, psf_out, n_fft, fine), axes=(1, 2))
    index = [np.rint(np.fft.fftfreq(k) * k).astype(int) for k in n_fft]
    p2 = np.fft.fft2(p2)[:, index[0][:, None], index[1]] / (fine * psf_out.spacing) ** 2
    nu = [i / k for i, k in zip(index, n_fft, strict=True)]
    f = np.abs(np.tensordot(matrix.T, np.stack(np.meshgrid(*nu, indexing="ij")), 1)).max(axis=0)
    p2 = np.where(f <= (1 + BAND_SLACK) / (2 * psf_out.spacing), p2, 0)
    # P1 is sampled on the model's pixels, so that its OTF is its FFT; P2i has the factor |det A|
    d, gain, floored_power = transfer_function(psf_in.otf(*nu), p2)
    return d, gain / abs(np.linalg.det(matrix)), floored_power
