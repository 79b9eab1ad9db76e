"""At which stage spectra are applied to the sources: where counted operations are fewest."""

from __future__ import annotations

import numpy as np

from .stages import Frames, Transformed

# An operation of a boxed product takes as long as so many of a large one, as its tiles are cut by
# the box and its terms are few; and one of a sum over sources or bands, which loads all that it
# multiplies. Fitted to processor times on one CPU with AVX-512 (1.7 and 12 on other scenes than
# these): what is chosen then takes 8 % more than the fastest stage at most. With larger values
# sources stay in frames more often.
BOXED, POINT = 1.9, 10.0


def flops(buffers, op, executor) -> list[float]:
    """Floating-point operations of one pair, weighed as above, at depths 0, 1 and 2.

    What all of them do, from frequencies to the observation and back, is left out.
    """
    e, n_images = executor, len(buffers.scenes) * op.shape_in[0]
    shape = buffers.host_boxes.shape[:, list(e.axes)].astype(float)
    rows, pixels = shape[:, 0].sum(), shape.prod(1).sum()
    first, second = n_images * e.n_y * e.n_x * e.k_pad, n_images * e.k_y * e.n_y * e.k_pad
    boxed = pixels * e.k_pad, rows * e.k_y * e.k_pad
    points = (
        1.5
        * op.shape_in[0]
        * np.array([pixels, rows * e.k_pad, buffers.n_sources * e.k_y * e.k_pad])
    )
    counts = first + second, BOXED * boxed[0] + second, BOXED * sum(boxed)
    return [4 * (count + POINT * point) for count, point in zip(counts, points, strict=True)]


def rendering(buffers, i_observation, op, depth=None):
    """The Frames or Transformed of one observation of a batch.

    depth: 0, 1 or 2; None takes that of the fewest operations
    """
    if depth is None:
        depth = 0 if op.is_identity else int(np.argmin(flops(buffers, op, op.executor())))
    if depth == 0:
        return Frames(buffers, i_observation, op)
    return Transformed(buffers, i_observation, op, depth)
