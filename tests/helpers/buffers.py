"""Device buffers that show reads of what nobody wrote, and writes beyond their end."""

import numpy as np

from clresample import Device

GUARD = np.full(1 << 14, 0xA5, np.uint8)  # 16 KiB: some rows of a small image


def fill_with_nan(patch):
    """Lets every new buffer of every device hold NaN, or the largest number of its type."""
    empty = Device.empty

    def filled(self, shape, dtype):
        array = empty(self, shape, dtype)
        kind = array.dtype.kind
        value = np.nan if kind in "fc" else np.iinfo(array.dtype).max
        if array.size:
            self.upload(np.full(array.shape, value, array.dtype), array)
        return array

    patch.setattr(Device, "empty", filled)


class Guards:
    """Bytes behind every new buffer of every device, looked at when the buffers are done with."""

    def __init__(self, patch):
        self._kept, allocate = [], Device._allocate

        def guarded(device, n_bytes):
            import pyopencl as cl

            buffer = allocate(device, n_bytes + GUARD.nbytes)
            cl.enqueue_copy(device.queue, buffer, GUARD, dst_offset=n_bytes)
            self._kept.append((device, buffer, n_bytes))
            return buffer

        patch.setattr(Device, "_allocate", guarded)

    def overwritten(self):
        """Sizes [bytes] of the buffers since the last call that were written beyond their end."""
        import pyopencl as cl

        found, bytes_behind = [], np.empty_like(GUARD)
        for device, buffer, n_bytes in self._kept:
            cl.enqueue_copy(device.queue, bytes_behind, buffer, src_offset=n_bytes)
            if not np.array_equal(bytes_behind, GUARD):
                found.append(n_bytes)
        self._kept.clear()
        return found
