"""Renders large scenes in windows: neighbouring sources in one small frame.

The cost of products along whole frames grows with the cube of their side. Here sources are grouped
by the cell of the frame that contains the middle of their box. Each group has its own frame, which
contains its boxes, and is rendered in a window of the observation as large as the reach of its
light, the padding of the model (resampling/transfer.py). Windows overlap, and their sum is the
observation's image; in the adjoint, each window is cut out of that. Kernels are in windows.cl.
"""

from __future__ import annotations

import copy
import functools

import numpy as np

from ....device.contraction import ImageBatch
from ....device.rounding import round_up
from ....resampling.plan import Precision
from ....resampling.resampler import EXECUTORS
from ...linear.placing import place_windows, reach_of
from ..boxes import Boxes

# [px] Sides of groups' frames are multiples of this, so that cached tables can be used after boxes
# were resized. A larger one gives more padding to compute.
ROUND_PX = 16


class WindowGroups:
    """Sources of a batch by the cell of `cell` (2,) [px] in which their boxes' middles lie.

    boxes: the batch's; which (n,): the sources that are meant
    group (S,): of each source, 0 of those that are not meant; scene (G,): of each group; low (G, 2)
    [px]: where its frame begins in that of its scene; shape (2,) [px]: of the groups' frames, one
    for all
    """

    def __init__(self, boxes, which, cell):
        origin, shape = boxes.origin[which], boxes.shape[which]
        at = ((origin + 0.5 * shape) // np.asarray(cell)).astype(int)
        at -= at.min(axis=0)
        n_y, n_x = at.max(axis=0) + 1
        keys = (boxes.scene[which] * n_y + at[:, 0]) * n_x + at[:, 1]
        cells, group = np.unique(keys, return_inverse=True)
        self.which, self.group = which, np.zeros(len(boxes), int)
        self.group[which] = group
        self.scene = cells // (n_y * n_x)
        self.low = np.full((len(cells), 2), np.iinfo(np.int64).max)
        high = np.zeros((len(cells), 2), np.int64)
        np.minimum.at(self.low, group, origin)
        np.maximum.at(high, group, origin + shape)
        self.shape = round_up((high - self.low).max(axis=0), ROUND_PX)

    def __len__(self):
        return len(self.scene)

    def buffers(self, buffers):
        """The batch with a scene for each group.

        Same arrays, other boxes, its own sources alone.
        """
        b, own = copy.copy(buffers), buffers.host_boxes
        b.scenes = [buffers.scenes[i] for i in self.scene]
        b.host_boxes = Boxes(self.group, own.origin - self.low[self.group], own.shape, own.center)
        b.boxes = b.host_boxes.put(b.device)
        b.all_sources = b.device.put(self.which, np.int32)
        group = self.group[self.which]
        counts = np.bincount(group, minlength=len(self))
        b.first = b.device.put(np.concatenate([[0], np.cumsum(counts)]), np.int32)
        b.order = b.device.put(self.which[np.argsort(group, kind="stable")], np.int32)
        return b


class WindowOperator:
    """Renders the frames of `groups` as `op` renders the scenes' own: (G, C, ny, nx) to windows.

    shape_in, shape_out (3,); low (G, 2): the windows' first pixels in the observation
    """

    def __init__(self, op, groups):
        plan, self.op, self._groups = op.plans[0], op, groups
        shape = tuple(groups.shape.tolist())
        self.plan = plan.window(shape, reach_of(plan), Precision.of(op.dtype))
        self._executor = EXECUTORS[plan.geometry](op.device, op.dtype, [self.plan])
        self.shape_in = plan.n_bands, *shape
        self.shape_out = plan.n_bands, *self.plan.mapping.shape_out
        self.place()

    def place(self):
        """Moves the windows to the operator's present shift."""
        mapping, small = self.op.plans[0].mapping, self.plan.mapping
        off = mapping.offset + self.op.shift - self._groups.low - small.offset
        self.low, moves = place_windows(off, mapping.matrix[None])
        self._executor.set_transfer([self.plan.shifted(move) for move in moves])

    def executor(self):
        """Executor with intermediates of its own."""
        return self._executor.clone()

    def queue_plain(self, way, source, target):
        """Queues "forward", windows = R frames of all groups, or "adjoint", its transpose."""
        n = len(self._groups) * self.shape_in[0]
        self._executor.reserve(n)
        getattr(self._executor, way)(ImageBatch.of(source), ImageBatch.of(target), n)


class _GroupRendering:
    """One set of Groups: their frames' rendering, and their windows of the observation."""

    def __init__(self, buffers, i_observation, op, groups, make):
        self.which, self.seen_by = groups.which, WindowOperator(op, groups)
        self.inner = make(groups.buffers(buffers), i_observation, self.seen_by)
        n_bands, w_y, w_x = self.seen_by.shape_out
        m_y, m_x = op.shape_out[1:]
        put = functools.partial(buffers.device.put, dtype=np.int32)
        self.windows = buffers.device.empty((len(groups), n_bands, w_y, w_x), buffers.dtype)
        self._low = put(self.seen_by.low)
        shared = {"n_bands": n_bands, "my": m_y, "mx": m_x, "wy": w_y, "wx": w_x, "low": self._low}
        shared["windows"] = self.windows
        first = np.searchsorted(groups.scene, np.arange(len(buffers.scenes) + 1))
        launcher = functools.partial(buffers.launcher, "windows.cl", n_axes=3)
        self._assemble = launcher("add_windows").bind(**shared, first=put(first))
        self._cut = launcher("cut_windows").bind(**shared, scene=put(groups.scene))
        self._assemble_size = buffers.sized(m_x, m_y, len(buffers.scenes) * n_bands)
        self._cut_size = buffers.sized(w_x, w_y, len(groups) * n_bands)

    def render(self, spectra, image, add):
        self.inner.render(spectra, self.windows)
        self._assemble(self._assemble_size, image=image, add=add)

    def back_project(self, image):
        self._cut(self._cut_size, image=image)
        self.inner.back_project(self.windows)

    def update_shifts(self):
        self.seen_by.place()
        self.seen_by.op.device.upload(self.seen_by.low.astype(np.int32), self._low)


class WindowRendering:
    """Rendering in windows, with the methods of stages.FrameRendering.

    buffers: the batch; i_observation: of it; op: the batch's operator there, of one plan
    parts: WindowGroups, which together have all sources; each has frames of its own size
    make: makes the rendering of their frames, see stage_selection
    """

    depth = 3

    def __init__(self, buffers, i_observation, op, parts, make):
        self.buffers = buffers
        self.parts = [_GroupRendering(buffers, i_observation, op, groups, make) for groups in parts]
        self._active: dict = {}

    def transform(self, morph):
        """Sets the morphologies (boxes.size,) for the launches that follow."""
        for part in self.parts:
            part.inner.transform(morph)

    def render(self, spectra, image):
        """Queues the image (B, Co, My, Mx) of the morphologies with spectra (S, C)."""
        for i, part in enumerate(self.parts):
            part.render(spectra, image, i > 0)

    def back_project(self, image):
        """Queues the adjoint of an image (B, Co, My, Mx) for the gradients that follow."""
        for part in self.parts:
            part.back_project(image)

    def gather_spectra(self, d_spectra):
        """Queues dA of this observation's channels into d_spectra (S, C)."""
        for part in self.parts:
            part.inner.gather_spectra(d_spectra)

    def gather_morph(self, spectra, d_morph, active, *, add=False):
        """Queues dS of the sources `active` (n,): written into d_morph, or added to it."""
        for part, own in zip(self.parts, self._own(active), strict=True):
            if own is not None:
                part.inner.gather_morph(spectra, d_morph, own, add=add)

    def update_shifts(self):
        """Copies the current shift of the operator."""
        for part in self.parts:
            part.update_shifts()

    def _own(self, active):
        """Of a device array of sources, the parts' own ones; None for a part that has none."""
        if id(active) not in self._active:
            device, given = self.buffers.device, self.buffers.device.get(active)
            lists = [given[np.isin(given, part.which)] for part in self.parts]
            arrays = [device.put(own, np.int32) if len(own) else None for own in lists]
            self._active[id(active)] = active, arrays  # stored, so that no other has its id
        return self._active[id(active)][1]
