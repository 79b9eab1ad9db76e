"""Boxes that follow the light: grown where it reaches their edge, trimmed where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..sky.extent import shared_part
from .solver.problem import Problem

# A box holds what reaches this part of the noise: the profile, or the structure that the prior
# allows about it (alpha = 0.1 of the root of the light); as a part of the peak, within bounds.
BOX_NOISE, BOX_FAINTEST, BOX_BRIGHTEST = 0.1, 1e-7, 5e-3
SMALLEST_RADIUS_PX = 5
# [px] by which a side grows where light reaches it, and from which on trimming is worth the move
GROW_PX, TRIM_PX = 8, 4
# A box grows when its edge is this much brighter than a tenth of the noise.
GROW_AT = 4.0


def box_threshold(brightness):
    """Part of the peak above which a pixel is worth its place; the peak is `brightness` sigma."""
    brightness = max(brightness, 1.0)
    return np.clip(min(BOX_NOISE / brightness, brightness**-2), BOX_FAINTEST, BOX_BRIGHTEST)


def box_around(base, position, brightness):
    """Box of one profile: origin (2,) and shape (2,) inside the frame, and its centre pixel (2,).

    base (Ny, Nx): profile; position (2,) [px]; brightness: its peak over the noise of a model
    pixel, in the channel that sees it best
    """
    threshold = box_threshold(brightness) * base.max()
    pixel = np.clip(np.floor(np.asarray(position) + 0.5).astype(int), 0, np.array(base.shape) - 1)
    lit = base > threshold
    low, high = np.zeros(2, int), np.zeros(2, int)
    for axis in (0, 1):
        along = np.flatnonzero(lit.any(axis=1 - axis))
        first, last = (along[0], along[-1]) if len(along) else (pixel[axis], pixel[axis])
        low[axis] = max(min(first, pixel[axis] - SMALLEST_RADIUS_PX), 0)
        high[axis] = min(max(last, pixel[axis] + SMALLEST_RADIUS_PX), base.shape[axis] - 1)
    return low, high - low + 1, pixel - low


def resized(problem: Problem, base, noise) -> Problem:
    """The problem in boxes that fit its present morphologies; itself where all of them do.

    base (S, Ny, Nx) [1]: expected profiles over the frame, max = 1; noise (C,): of a model pixel
    The solver's state moves along: new pixels start at the profile, with no moments.
    """
    boxes = [_box(problem, i, base, noise) for i in range(len(problem.morph))]
    if all(_same(problem, i, box) for i, box in enumerate(boxes)):
        return problem

    def move(arrays, fill=None):
        return [
            _moved(a, o, low, high, None if fill is None else fill[i])
            for i, (a, o, (low, high)) in enumerate(zip(arrays, problem.origin, boxes, strict=True))
        ]

    moments = problem.moments_morph
    return replace(
        problem,
        origin=np.array([low for low, _ in boxes]),
        center=problem.center + problem.origin - np.array([low for low, _ in boxes]),
        base=move(problem.base, base),
        morph=move(problem.morph, base),
        field=move(problem.field),
        moments_morph=None if moments is None else [move(m) for m in moments],
    )


def _box(problem, i, base, noise):
    """First and one-past-last pixel (2,) of the box that source i should have."""
    morph, low = problem.morph[i], np.array(problem.origin[i])
    high = low + morph.shape
    if problem.fixed[i]:
        return low, high
    brightness = (problem.spectra[i] * morph.max() / noise).max()
    wanted, size, _ = box_around(base[i], low + problem.center[i], brightness)
    light = BOX_NOISE / max(brightness, 1e-30) * morph.max()
    new_low, new_high = low.copy(), high.copy()
    for axis in (0, 1):
        along = morph.max(axis=1 - axis)
        lit = low[axis] + np.flatnonzero(along > light)
        first = min([wanted[axis], *lit[:1]])
        last = max([wanted[axis] + size[axis], *(lit[-1:] + 1)])
        if along[0] > GROW_AT * light:
            new_low[axis] = max(low[axis] - GROW_PX, 0)
        elif first - low[axis] >= TRIM_PX:
            new_low[axis] = first
        if along[-1] > GROW_AT * light:
            new_high[axis] = min(high[axis] + GROW_PX, problem.extent[axis])
        elif high[axis] - last >= TRIM_PX:
            new_high[axis] = last
    return new_low, new_high


def _same(problem, i, box):
    low, high = box
    return np.array_equal(low, problem.origin[i]) and np.array_equal(
        high - low, problem.morph[i].shape
    )


def _moved(array, origin, low, high, fill):
    """The array of a box at `origin`, in the box from `low` to `high`; new pixels from `fill`."""
    y, x = (slice(a, b) for a, b in zip(low, high, strict=True))
    out = np.zeros(high - low, array.dtype) if fill is None else fill[y, x].astype(array.dtype)
    here, there = shared_part(low, high - low, origin, array.shape)
    out[here] = array[there]
    return out
