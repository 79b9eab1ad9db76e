"""Executor of any positions: a finer plane along the model's axes, interpolated at each pixel."""

from __future__ import annotations

import math

import numpy as np

from ..device.contraction import ImageBatch
from ..device.rounding import round_up
from .aligned import AlignedExecutor
from .wave_tables import TAPS_PAD

# Observed pixels of a work-item on CPUs: so many that its start takes no time.
RUN_PX = 64


class DistortedExecutor(AlignedExecutor):
    """Any positions: the rows and columns of a finer plane, then a sparse sum for each pixel.

    Sy (I, ky), Sx (kx, J): waves at the rows and columns of the plane, about its middle
    points: from the plane to the P = My Mx observed pixels, and back
    """

    def __init__(self, device, dtype, plans):
        super().__init__(device, dtype, plans)
        self.points = PointInterpolation(self, [plan.points for plan in plans])

    def mirrored(self, name) -> bool:
        """As the base's; planes of several sizes have no common middle."""
        sides = {(len(plan.out_y), plan.out_x.shape[1]) for plan in self.plans}
        return super().mirrored(name) and (len(sides) == 1 or name.startswith("in"))

    def scratch_shapes(self):
        return super().scratch_shapes() | {"plane": (self.n_rows, self.n_columns)}

    def frequencies_to_pixels(self, y: ImageBatch, n):
        """I2 = gather(G),  G = Sy Z Sx;  y (n, P): the observation I2 of each band, overwritten"""
        super().frequencies_to_pixels(self._plane, n)
        self.points.to_pixels(self._plane, y, n, self.which)

    def pixels_to_frequencies(self, y: ImageBatch, n):
        """Z = conj(D) o (Sy^T G Sx^T),  G = gather^T(I2);  y (n, P): I2"""
        self.points.to_plane(y, self._plane, n, self.which)
        super().pixels_to_frequencies(self._plane, n)

    @property
    def _plane(self) -> ImageBatch:
        """G, in scratch "plane"."""
        shape = self.n_rows, self.n_columns
        return ImageBatch.shaped(*shape)._replace(buffer=self.scratch["plane"].base_data)


class PointInterpolation:
    """Sparse sums from planes (I, J) to pixels anywhere on them, and their transpose.

    points: PointTaps of each plan
    """

    def __init__(self, executor, points):
        device, dtype, tuning = executor.device, executor.dtype, executor.tuning
        self.n_rows, self.n_columns = executor.n_rows, executor.n_columns
        self.n_positions = math.prod(executor.plans[0].mapping.shape_out)
        self.by_run, self.whole_groups = tuning.row_loops, executor.whole_groups
        n, n_most, n_taps = len(points), max(len(p.pixel) for p in points), points[0].n_taps
        n_pad = round_up(n_taps, TAPS_PAD)
        rank, pixel = np.full((n, self.n_positions), -1), np.zeros((n, n_most))
        start, weight = np.zeros((n, n_most, 2)), np.zeros((n, n_most, 2, n_pad), dtype)
        first = np.zeros((n, self.n_rows * self.n_columns + 1))
        for i, p in enumerate(points):
            m = len(p.pixel)
            rank[i, p.pixel], pixel[i, :m] = np.arange(m), p.pixel
            start[i, :m], weight[i, :m, :, :n_taps] = p.start, p.weight
            cells = np.arange(first.shape[1])
            first[i] = np.searchsorted(p.start @ (self.n_columns, 1), cells)
        line = 1 if self.by_run else tuning.line_group
        shared = {"N_TAPS": n_taps, "N_PAD": n_pad, "RUN": RUN_PX, "ROWS": self.by_run}
        self._to_pixels, self._to_plane = (
            device.launcher("points.cl", name, dtype=dtype, local_size=(line, *ones), **shared)
            for name, ones in (("plane_to_points", (1,)), ("points_to_plane", (1, 1)))
        )
        tables = {"start": device.put(start, np.int32), "weight": device.put(weight)}
        for launch in (self._to_pixels, self._to_plane):
            launch.bind(n_positions=self.n_positions, n_most=n_most, n_bands=executor.n_bands)
            launch.bind(n_rows=self.n_rows, n_columns=self.n_columns, n_tables=n, **tables)
        self._to_pixels.bind(rank=device.put(rank, np.int32))
        self._to_plane.bind(pixel=device.put(pixel, np.int32), first=device.put(first, np.int32))

    def to_pixels(self, plane: ImageBatch, y: ImageBatch, n, which):
        """Queues the sums of n planes (I, J) to y (n, P); which: the executor's."""
        p = self.n_positions
        size = -(-p // RUN_PX) if self.by_run else self.whole_groups(p), n
        self._to_pixels(size, which=which, plane=plane.buffer, y=y.buffer, y_offset=y.offset)

    def to_plane(self, y: ImageBatch, plane: ImageBatch, n, which):
        """Queues the transpose: y (n, P) to n planes (I, J)."""
        size = 1 if self.by_run else self.whole_groups(self.n_columns), self.n_rows, n
        self._to_plane(size, which=which, plane=plane.buffer, y=y.buffer, y_offset=y.offset)
