"""Selects the rendering of an observation by counted operations.

The choice is the stage at which spectra are applied to the sources.
"""

from __future__ import annotations

import numpy as np

from ....device.contraction import round_up_columns
from ...linear.placing import reach_of
from .stages import BoxTransformRendering, FrameRendering
from .windows import WindowGroups, WindowRendering

# Cost of an operation relative to one of a large product: first in a product of the size of a box,
# whose tiles are cut by the box and whose sums are short; then in a sum over sources or bands,
# which loads all its factors from memory. Fitted to processor times on one CPU with AVX-512 (1.7
# and 12 on other scenes): the selected stage then takes at most 8 % more time than the fastest.
# With larger values frames are selected more often.
BOX_COST, SUM_COST = 1.9, 10.0
# Numbers of cells along a side of a frame that are tried for windows, and the largest ratio of
# their operations to those of frames. The count is an estimate, and small products, cutting and
# adding windows take longer: measured times are 1.3 to 2.6 times the estimate, most of all for six
# bands rotated against the model. With 0.7, six bands of scenes of 256 pixels a side take 1.6 times
# as long as in frames.
CELLS, MAX_WINDOW_COST = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32), 0.4
# Sources whose boxes exceed the median by this factor may get windows of their own, since the
# largest box determines the frame of all groups.
LARGE = np.array([1.3, 1.6, 2.0])


def stage_flops(buffers, op, executor) -> list[float]:
    """Floating-point operations of one pair, weighed as above, at depths 0, 1 and 2.

    Operations common to all depths, between frequencies and the observation, are not counted.
    """
    e, shape = executor, buffers.host_boxes.shape[:, list(executor.axes)]
    waves = np.stack([e.k_ys, round_up_columns(e.k_xs)], axis=1)
    of_plan = np.arange(len(buffers.scenes)) % len(waves)  # one serves all scenes, or each has one
    of_frame, of_box = waves[of_plan], waves[of_plan[buffers.host_boxes.scene]]
    return _counts(shape, op.shape_in[0], e.n_y, e.n_x, of_frame, of_box)


def _counts(shape, n_bands, n_y, n_x, of_frame, of_box):
    """`stage_flops` of boxes of `shape` (S, 2), of each frame (n_frames, 2) and each box (S, 2).

    Frames of (n_y, n_x) with so many waves along y and x.
    """
    shape, (k_y, k_x), (b_y, b_x) = shape.astype(float), of_frame.T, of_box.T
    rows, pixels = shape[:, 0], shape.prod(1)
    first, second = n_bands * n_y * n_x * k_x.sum(), n_bands * n_y * k_y @ k_x
    boxed = pixels @ b_x, (rows * b_y) @ b_x
    points = 1.5 * n_bands * np.array([pixels.sum(), rows @ b_x, b_y @ b_x])
    counts = first + second, BOX_COST * boxed[0] + second, BOX_COST * sum(boxed)
    return [4 * (count + SUM_COST * point) for count, point in zip(counts, points, strict=True)]


def select_rendering(buffers, i_observation, op, depth=None):
    """The FrameRendering, BoxTransformRendering or WindowRendering of one observation of a batch.

    depth: 0, 1, 2, or 3 for windows; None takes that of the fewest operations
    """
    parts = None
    if depth is None and not op.is_identity:
        counts = stage_flops(buffers, op, op.executor())
        depth = int(np.argmin(counts))
        parts = _parts(buffers, op, counts[depth])
    elif depth == 3:
        everyone = np.arange(buffers.n_sources)
        parts = [WindowGroups(buffers.host_boxes, everyone, np.array(op.shape_in[1:]) / 2)]
    if parts is not None:
        return WindowRendering(buffers, i_observation, op, parts, _in_frames)
    return _in_frames(buffers, i_observation, op, depth or 0)


def _in_frames(buffers, i_observation, op, depth=None):
    """The FrameRendering or BoxTransformRendering of one observation."""
    if depth is None:
        depth = int(np.argmin(stage_flops(buffers, op, op.executor())))
    if depth == 0:
        return FrameRendering(buffers, i_observation, op)
    return BoxTransformRendering(buffers, i_observation, op, depth)


def _parts(buffers, op, count):
    """Groups of all sources whose windows take fewer operations than `count`, or None.

    Those from frequencies to the observation are still to be added.
    """
    plan, boxes = op.plans[0], buffers.host_boxes
    if len(op.plans) > 1 or op.n_terms > 1 or op.geometry == "distorted":
        return None
    middling, side = np.median(boxes.shape, axis=0), np.array(op.shape_in[1:])
    if (middling + 2 * reach_of(plan) > side / 2).any():
        return None  # no frame of a group would be much smaller than the scenes' own
    n_images, sides = len(buffers.scenes) * op.shape_out[0], boxes.shape.max(axis=1)
    e = op.executor()
    observed = _observed(plan, e.n_rows, e.n_columns, e.k_y, e.k_x)
    least, found = MAX_WINDOW_COST * (count + 4 * n_images * observed), None
    limits = LARGE * np.median(sides)
    for limit in (np.inf, *limits[limits < sides.max()]):
        split = [np.flatnonzero(part) for part in (sides <= limit, sides > limit)]
        best = [_best_groups(buffers, op, which) for which in split if len(which)]
        total = sum(one for one, _ in best)
        if total < least:
            least, found = total, [groups for _, groups in best]
    return found


def _best_groups(buffers, op, which):
    """Operations of one pair of the sources `which` (n,) in windows, and the Groups of fewest."""
    boxes, side = buffers.host_boxes, np.array(op.shape_in[1:])
    tried = [WindowGroups(boxes, which, side / n_cells) for n_cells in CELLS]
    inverse = np.abs(np.linalg.inv(op.plans[0].mapping.matrix))
    counts = [_window_flops(boxes, op, groups, inverse) for groups in tried]
    best = int(np.argmin(counts))
    return counts[best], tried[best]


def _window_flops(boxes, op, groups, inverse):
    """Operations of one pair in windows, all of them, weighed as in `stage_flops`.

    Estimated from the tables of the whole frame, whose frequencies and columns grow with its side.

    inverse (2, 2): of the mapping's matrix, without signs
    """
    e, plan, n_bands = op.executor(), op.plans[0], op.shape_out[0]
    axes, reach = list(e.axes), reach_of(plan)
    n, side = groups.shape[axes], np.array([e.n_y, e.n_x])
    k_y, k_x = np.array([e.k_y, e.k_x]) * (n + 2 * reach) / (side + reach)
    seen = inverse @ (groups.shape + 2 * reach)
    n_rows, n_columns = seen
    if plan.lines is not None:
        n_rows = seen[0 if plan.lines.by_row else 1]
        n_columns = e.n_columns * (n[1] + 2 * reach) / side[1]
    observed = _observed(plan, n_rows, n_columns, k_y, k_x)
    shape, waves = boxes.shape[groups.which][:, axes], np.array([[k_y, k_x]])
    alike = np.repeat(waves, len(groups), axis=0), np.repeat(waves, len(shape), axis=0)
    first = _counts(shape, n_bands, *n, *alike)
    return min(first) + 4 * len(groups) * n_bands * observed


def _observed(plan, n_rows, n_columns, k_y, k_x):
    """Products in an executor's `observe` of one image."""
    if plan.lines is None:
        return n_rows * k_x * (k_y + n_columns)
    return k_y * n_columns * (k_x + n_rows)
