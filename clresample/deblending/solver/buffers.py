"""A batch of scenes on the device: uploads, and downloads of states."""

from __future__ import annotations

import numpy as np

from ...device.rounding import round_up
from ...device.tuning import Tuning
from .boxes import ALIGN, Boxes

# Items of a work-item on CPUs: PoCL takes 50 ns to start one, the time of many items.
ITEMS_EACH = 64


class SceneBuffers:
    """The arrays of B scenes of one signature, with S sources in all, on one device.

    scenes, device, dtype, tuning: Scenes, Device, NumPy type, Tuning
    all_sources (n,): int32, the sources that are rendered, all of them
    first (B + 1,), order (n,): int32, those by scene, and the first of each scene in that;
        host_first: the same of all sources, on the host
    boxes, host_boxes: of all sources, with and without their table on the device
    free (n_free,): int32, the sources whose morphology is fitted; everyone's are in boxes
    profile, amplitude, morph, d_morph (boxes.size,): flat, laid out by the boxes: expected
        morphologies, the scatter that the prior allows about them (0 without one), S, dL/dS
    spectra, d_spectra (S, C); sky (B, C)
    """

    def __init__(self, scenes, states, device, dtype, prior):
        self.scenes, self.device, self.dtype = scenes, device, np.dtype(dtype)
        self.tuning = Tuning.of(device, dtype)
        counts = [len(s.origin) for s in scenes]
        self.host_first = np.concatenate([[0], np.cumsum(counts)])
        self.first = device.put(self.host_first, np.int32)
        self.host_boxes = Boxes(
            np.repeat(np.arange(len(scenes)), counts),
            np.concatenate([s.origin for s in scenes]),
            np.array([m.shape for s in scenes for m in s.profile]),
            np.concatenate([s.center for s in scenes]),
        )
        self.boxes = self.host_boxes.put(device)
        self.all_sources = self.order = self.boxes.everyone
        free = np.flatnonzero(~np.concatenate([s.fixed for s in scenes]))
        self.n_free = len(free)
        self.free = device.put(free if self.n_free else [0], np.int32)

        self.profile = self.flat([s.profile for s in scenes])
        amplitude = prior.amplitude if prior else np.zeros_like
        self.amplitude = self.flat([[amplitude(p) for p in s.profile] for s in scenes])
        self.morph = self.flat([s.morph for s in states])
        self.spectra = self.put(np.concatenate([s.spectra for s in states]))
        self.sky = self.put(np.array([s.sky for s in states]))
        self.d_morph, self.d_spectra = self.zeros_flat(), self.zeros_like_spectra()

    @property
    def n_sources(self) -> int:
        """S, of all scenes."""
        return len(self.host_boxes)

    @property
    def n_channels(self) -> int:
        """C, of all observations of a scene."""
        return self.spectra.shape[1]

    @property
    def iterated(self):
        """Device buffers that the iterations change: morph, spectra, sky."""
        return self.morph, self.spectra, self.sky

    def put(self, values):
        """Values on the device, in the batch's floating type."""
        return self.device.put(values, self.dtype)

    def flat(self, morphs):
        """Arrays (ny, nx) of each source of each scene, on the device as one flat buffer."""
        return self.put(
            self.host_boxes.pack([m for scene in morphs for m in scene], dtype=self.dtype)
        )

    def zeros_flat(self):
        """A flat buffer of zeros, laid out by the boxes."""
        return self.device.zeros(self.host_boxes.size, self.dtype)

    def zeros_like_spectra(self):
        """Zeros (S, C)."""
        return self.device.zeros(self.spectra.shape, self.dtype)

    def launcher(self, file, name, n_axes, *, local_size=None, **defines):
        """A Launcher of a kernel with `n_axes` launch axes, built for this device's tuning.

        defines: more macros; local_size: None takes the tuning's
        """
        return self.device.launcher(
            file,
            name,
            dtype=self.dtype,
            local_size=local_size or self.tuning.local_size(n_axes),
            **{"ROWS": self.tuning.row_loops, "WG": self.tuning.sum_group, "ALIGN": ALIGN}
            | defines,
        )

    def scene_launcher(self, name, local_size=None):
        """A Launcher of a kernel of scene.cl, all of one build."""
        return self.launcher("scene.cl", name, 3, local_size=local_size, VW=self.tuning.tile["VW"])

    def along_row(self, n):
        """Work-items for rows of `n` pixels: one where it walks the row, else one a pixel."""
        return 1 if self.tuning.row_loops else int(n)

    def box_rows(self, n_boxes):
        """A launch over the rows of `n_boxes` boxes, any of them as large as the largest."""
        tallest, widest = self.host_boxes.shape.max(0)
        return self.sized(widest, tallest, n_boxes)

    def strided_rows(self, shapes, n_boxes):
        """A launch over the rows of `n_boxes` boxes of some `shapes` (S, 2), see FOR_Y.

        It has the work-items of boxes of the mean shape: with those of the largest box nine in ten
        would have no work where a few boxes are large.
        """
        n_y, n_x = np.ceil(np.mean(shapes, axis=0)).astype(int).tolist()
        return self.sized(n_x, n_y, n_boxes)

    def items(self, n):
        """A launch for `n` items, several a work-item on CPUs; see FOR_I of work_group.h."""
        if self.tuning.row_loops:
            return (-(-n // ITEMS_EACH),)
        return (round_up(n, *self.tuning.local_size(1)),)

    def sized(self, n_x, n_y, n_z):
        """A launch over rows of n_x pixels, n_y of them, in whole groups of the tuning."""
        group = self.tuning.local_size(3)
        size = self.along_row(n_x), int(n_y), n_z
        return tuple(map(round_up, size, group))

    def split(self, rows):
        """Arrays (S, ...) of all sources, split by scene."""
        return np.split(rows, self.host_first[1:-1])

    def unpack(self, flat):
        """A flat buffer's values: for each scene, its sources' arrays (ny, nx)."""
        arrays = self.host_boxes.unpack(flat)
        return [arrays[a:b] for a, b in zip(self.host_first, self.host_first[1:])]

    def morphologies(self, which):
        """The morphologies of the scenes `which` (B,), likewise; of others without meaning."""
        starts = np.append(self.host_boxes.offset, self.host_boxes.size)[self.host_first]
        parts = np.stack([starts[:-1], starts[1:]], axis=1)[which]
        return self.unpack(self.device.get_parts(self.morph, parts))

    def downloaded(self, morph, spectra, sky):
        """Morphologies, spectra and sky levels of each scene, of device arrays like these."""
        morph, *numbers = self.device.get_all([morph, spectra, sky])
        spectra, sky = (values.astype(float) for values in numbers)
        return self.unpack(morph), self.split(spectra), sky
