"""Boxes: the layout of the morphologies of all sources and scenes in one flat buffer.

Source s owns ny * nx elements from offset[s], row by row. Every box starts at a multiple of ALIGN
elements; the few elements between two boxes are padding, zero when packed here and never read.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from ...device.rounding import round_up

# Elements between possible starts of boxes: the widest OpenCL vector, one 64-byte cache line of
# float32. Offsets are stored in these units, so that int32 reaches 2^35 elements.
ALIGN = 16
# The columns of the table that kernels read, each int32.
COLUMNS = ("scene", "y0", "x0", "ny", "nx", "cy", "cx", "offset / ALIGN")


@dataclass(frozen=True, eq=False)
class Boxes:
    """The boxes of S sources on the model frames of their scenes.

    scene (S,): the scene of each source
    origin (S, 2) [px]: y0, x0 of the box's first pixel in the model frame; may be outside of it
    shape (S, 2) [px]: ny, nx
    center (S, 2) [px]: the pixel of the box, 0 <= center < shape, around which the morphology
        falls and is symmetric; default (shape - 1) // 2
    offset (S,): first element in the flat buffer, a multiple of ALIGN; set here
    size: elements of the flat buffer
    Raises ValueError if arrays disagree, a box is empty or a centre lies outside its box.
    """

    scene: np.ndarray
    origin: np.ndarray
    shape: np.ndarray
    center: np.ndarray | None = None
    offset: np.ndarray = field(init=False)
    size: int = field(init=False)

    def __post_init__(self):
        shape = _integers("shape", self.shape, 2)
        center = (shape - 1) // 2 if self.center is None else _integers("center", self.center, 2)
        scene = _integers("scene", self.scene, 1)
        origin = _integers("origin", self.origin, 2)
        for name, array in (("origin", origin), ("shape", shape), ("center", center)):
            if len(array) != len(scene):
                raise ValueError(f"{name} has {len(array)} boxes, scene has {len(scene)}")
        _refuse(scene < 0, "scene is {} for source {}: it counts from 0", scene)
        _refuse((shape < 1).any(1), "shape is {} for source {}: at least 1 pixel a side", shape)
        outside = ((center < 0) | (center >= shape)).any(1)
        _refuse(outside, "center is {} for source {}, outside its box of shape {}", center, shape)
        n_pixels = shape.astype(np.int64).prod(1)
        end = np.cumsum(round_up(n_pixels, ALIGN))
        offset = np.concatenate([[0], end])
        if offset[-1] // ALIGN > np.iinfo(np.int32).max:
            raise ValueError(f"shape needs {offset[-1]} elements in all, more than {2**31 * ALIGN}")
        values = (scene, origin, shape, center, offset[:-1], int(offset[-1]))
        for item, value in zip(fields(self), values, strict=True):
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, item.name, value)

    def __len__(self):
        return len(self.scene)

    def __repr__(self):
        n_scenes = len(np.unique(self.scene))
        return f"Boxes({len(self)} sources in {n_scenes} scenes, {self.size} elements)"

    @property
    def table(self):
        """The table for kernels (S, 8) int32, with the columns COLUMNS."""
        return np.column_stack(
            [self.scene, self.origin, self.shape, self.center, self.offset // ALIGN]
        ).astype(np.int32)

    def pack(self, morphs, *, dtype=np.float32):
        """One flat buffer (size,) from S arrays (ny, nx)."""
        if len(morphs) != len(self):
            raise ValueError(f"morphs has {len(morphs)} arrays for {len(self)} boxes")
        flat = np.zeros(self.size, dtype)
        for i_source, (morph, view) in enumerate(zip(morphs, self.unpack(flat), strict=True)):
            if np.shape(morph) != view.shape:
                raise ValueError(
                    f"morphs[{i_source}] has shape {np.shape(morph)}, its box has {view.shape}"
                )
            view[...] = morph
        return flat

    def unpack(self, flat):
        """S views (ny, nx) into a flat NumPy buffer (size,)."""
        if flat.shape != (self.size,):
            raise ValueError(f"flat has shape {flat.shape}, the boxes take ({self.size},)")
        return [
            flat[start : start + ny * nx].reshape(ny, nx)
            for start, (ny, nx) in zip(self.offset, self.shape.tolist(), strict=True)
        ]

    def put(self, device):
        """The boxes with their table on a device."""
        return DeviceBoxes(self, device)


class DeviceBoxes:
    """Boxes and their tables for kernels on one device.

    boxes: the Boxes; device: the Device
    table (S, 8): int32, columns COLUMNS; everyone (S,): int32, the indices of all sources
    """

    def __init__(self, boxes, device):
        self.boxes = boxes
        self.device = device
        self.table = device.put(boxes.table)
        self.everyone = device.put(np.arange(len(boxes), dtype=np.int32))

    def __len__(self):
        return len(self.boxes)

    def __repr__(self):
        return f"{self.boxes!r} on {self.device!r}"

    def active(self, which):
        """A device array of int32 indices of sources.

        which: None for all; a mask (S,) of bools; indices; or such a device array, returned as is
        """
        if which is None:
            return self.everyone
        if not isinstance(which, (np.ndarray, list, tuple)):
            return which
        which = np.asarray(which)
        if which.dtype == bool:
            if which.shape != (len(self),):
                raise ValueError(f"active has shape {which.shape} for {len(self)} sources")
            which = np.flatnonzero(which)
        bad = (which < 0) | (which >= len(self))
        if bad.any():
            raise ValueError(f"active names source {which[bad][0]}, there are {len(self)}")
        return self.device.put(which, np.int32)


def _integers(name, values, n_dim):
    """An int32 copy (S,) or (S, 2)."""
    array = np.array(values, ndmin=n_dim)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} is of type {array.dtype}, must be whole pixels")
    if array.ndim != n_dim or (n_dim == 2 and array.shape[1] != 2):
        wanted = "(S,)" if n_dim == 1 else "(S, 2)"
        raise ValueError(f"{name} has shape {array.shape}, must be {wanted}")
    return array.astype(np.int32)


def _refuse(bad, message, values, others=None):
    """ValueError for the first source of `bad` (S,): message with its values and its index."""
    if bad.any():
        i_source = int(np.argmax(bad))
        more = () if others is None else (tuple(others[i_source].tolist()),)
        raise ValueError(message.format(values[i_source].tolist(), i_source, *more))
