"""Renders images of boxes in an observation, in windows that contain their light."""

from __future__ import annotations

import numpy as np

from ...device.contraction import ImageBatch, MatrixBatch
from ...device.tuning import MAX_GROUPS
from ...resampling.resampler import EXECUTORS


class BoxRenderer:
    """Plans of boxes of one shape on the device: images (n, ny, nx) to (n, C, wy, wx).

    plans: from `ResamplingPlan.window`, of equal layout and window; or the plans of one position of
        a distorted mapping, or of a whole frame
    executor: of the plans, with their transfer functions; None = a new one

    size (2,) [px]: of the windows

    A box is transformed once for all bands and slots. Its transform is multiplied by the phase of
    each slot's offset and by the transfer functions of the bands, which are sums of terms for each
    slot if the PSF varies (kernels/terms.cl, apply_transfer).
    """

    def __init__(self, device, dtype, plans, executor=None):
        self.plans, self.device, self.dtype = plans, device, np.dtype(dtype)
        self.size = plans[0].mapping.shape_out
        if executor is None:
            executor = EXECUTORS[plans[0].geometry](device, dtype, plans)
            executor.set_transfer([(plan.d_plus, plan.d_minus) for plan in plans])
        self.executor = e = executor
        elements = sum(rows * ld for rows, ld in e.scratch_shapes().values()) * e.n_bands
        self._n_bytes = (elements + e.k_y * e.k_pad) * self.dtype.itemsize
        self._capacity = 0
        tuning = e.tuning
        self._width = 1 if tuning.row_loops else e.k_pad // 2
        self._nu = [np.zeros((len(plans), n)) for n in (e.h_y, e.k_pad // 2)]
        for i, plan in enumerate(plans):
            for nu, own in zip(self._nu, plan.nu, strict=True):
                nu[i, : len(own)] = own
        self._turn = device.launcher(
            "terms.cl",
            "apply_transfer",
            dtype=dtype,
            local_size=tuning.local_size(3),
            ROWS=tuning.row_loops,
            TERMS=e.n_terms,
        ).bind(h_y=e.h_y, n_pad=e.k_pad, n_bands=e.n_bands, n_plans=len(plans), D=e.transfer)

    @property
    def n_elements(self) -> int:
        """Elements of one image in all bands."""
        return self.executor.n_bands * int(np.prod(self.size))

    def __call__(self, images, i_image, seen, i_seen, n, which, moves, shares=None):
        """Queues the rendering of n images for each of several consecutive slots.

        images, i_image: device array of the input, and its first element
        seen, i_seen: device array of the result, and its first element
        which (slots,): index of each slot's plan
        moves (slots, 2) [model px]: distance of the slots' pixels from those of the plan
        shares (slots, C, T): coefficients of the plan's terms, None for one term
        """
        e, count, (w_y, w_x) = self.executor, len(moves), self.size
        fit = min(e.tuning.group_bytes // (n * self._n_bytes), MAX_GROUPS // (n * e.n_bands))
        group = min(count, max(1, fit))
        self._reserve(group * n)
        phases = np.ascontiguousarray(self._phases(which, moves), self.dtype)
        phase = self.device.empty(phases.shape, self.dtype)
        self._sent = self.device.upload(phases, phase, wait=False)  # until the next call
        self._turn.bind(shares=phase if shares is None else self.device.put(shares, self.dtype))
        for first in range(0, count, group):
            m = min(group, count - first) * n
            at, to = i_image + first * n * e.n_y * e.n_x, i_seen + first * n * self.n_elements
            if e.which is not None:
                e.select_plans(np.repeat(which[first : first + group], n))
            e.in_columns_once(m, a=ImageBatch(images.base_data, at, e.n_y * e.n_x, e.n_x))
            self._rows(m)
            self._turn((self._width, e.h_y, m * e.n_bands), n=n, first=first, phase=phase)
            e.frequencies_to_pixels(ImageBatch(seen.base_data, to, w_y * w_x, w_x), m * e.n_bands)

    def _reserve(self, n_images):
        """Reserves memory for a number of images at a time."""
        if n_images <= self._capacity:
            return
        # twice as many at a time, since their number changes; at most those of one launch
        e, most = self.executor, self.executor.tuning.group_bytes // self._n_bytes
        self._capacity = n_images = max(n_images, min(2 * self._capacity, most))
        if e.which is not None:
            e.which = self.device.empty(n_images, np.int32)
        e.reserve(n_images * e.n_bands)
        plain = self.device.zeros((n_images, e.k_y, e.k_pad), self.dtype)
        z0 = MatrixBatch(plain.base_data, e.k_pad, e.k_y * e.k_pad)
        half, own = e.matrix("half", e.n_y), e.item_sizes(m=e.k_ys, n=e.k_xs)
        in_y = e.in_y._replace(items_per_matrix=1)
        self._rows = e.waves("in_y", "left").bind(e.k_y, e.k_x, e.n_y, in_y, half, z0, own=own)
        self._turn.bind(z0=z0.buffer, z=e.matrix("frequencies").buffer, which=e.which)

    def _phases(self, which, moves):
        """cos and sin (slots, Hy + k_pad / 2, 2) of each slot's offset by row and by column."""
        axes = self.plans[0].axes
        angles = [
            2 * np.pi * moves[:, axis, None] * nu[which]
            for nu, axis in zip(self._nu, axes, strict=True)
        ]
        angle = np.concatenate(angles, axis=1)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
