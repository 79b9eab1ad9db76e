"""Arrays on the device, uploaded once for as long as the host has them."""

from __future__ import annotations

import weakref

import numpy as np


class ResidentImages:
    """Device copies of host arrays, each found again by the array itself.

    Images that were uploaded in other batches are copied on the device. An array must not change
    once it is here: it becomes read-only.

    device: the Device
    """

    def __init__(self, device):
        self._device = device
        # (id of an array, dtype): weak reference to it, device array (n, ...), its row there
        self._rows: dict[tuple, tuple] = {}

    def stack(self, images, dtype):
        """Device array (n, ...) of images (n) of one shape, which others share: only to be read."""
        dtype = np.dtype(dtype)
        new = {id(image): image for image in images if (id(image), dtype) not in self._rows}
        if new:
            uploaded = self._device.put(np.stack(list(new.values())), dtype)
            for row, image in enumerate(new.values()):
                self._keep(image, dtype, uploaded, row)
        rows = [self._rows[id(image), dtype][1:] for image in images]
        first = rows[0][0]
        if len(first) == len(rows) and all(
            array is first and at == i for i, (array, at) in enumerate(rows)
        ):
            return first
        out = self._device.empty((len(rows), *first.shape[1:]), dtype)
        for i, (array, at) in enumerate(rows):
            self._device.copy(array[at], out[i])
        return out

    def _keep(self, image, dtype, array, row):
        key = id(image), dtype
        image.flags.writeable = False
        self._rows[key] = weakref.ref(image, lambda _: self._rows.pop(key, None)), array, row
