"""Boxes that follow the light: grown where it reaches their edge, trimmed where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..sky.box import box_slices, intersect_boxes
from .solver.scene import Scene, State

# A box holds the pixels where the source is brighter than this part of the noise of a model pixel;
# smaller values make larger boxes, which cost time and hold no more light that is seen.
BOX_NOISE = 0.1
# Least and largest threshold, as parts of the profile's peak: a star of any brightness ends where
# its PSF's float32 does; the box of a source that is hardly seen still holds its profile.
BOX_FAINTEST, BOX_BRIGHTEST = 1e-7, 5e-3
# [px] Boxes reach at least this far from their centre, however faint the source.
SMALLEST_RADIUS_PX = 5
# [px] by which a side grows where light reaches it, and the least by which one is trimmed: each
# change of a box makes a new engine.
GROW_PX, TRIM_PX = 8, 4
# A side grows when a pixel of its edge is brighter than this many times BOX_NOISE.
GROW_AT = 4.0


def box_threshold(brightness):
    """Part of a profile's peak down to which its pixels belong into its box.

    brightness: the peak over the noise of a model pixel. A pixel belongs there if the profile
    reaches BOX_NOISE of the noise, or if the structure does that the prior allows about it: with
    alpha = 0.1 that is 0.1 sqrt(profile) of the peak, so the profile's part is brightness^-2
    """
    brightness = max(brightness, 1.0)
    return np.clip(min(BOX_NOISE / brightness, brightness**-2), BOX_FAINTEST, BOX_BRIGHTEST)


def box_around(profile, position, brightness):
    """Box of one profile: origin (2,) and shape (2,) inside the frame, and its centre pixel (2,).

    profile (Ny, Nx): over the frame; position (2,) [px]; brightness: its peak over the noise of a
    model pixel, in the channel that sees it best
    """
    threshold = box_threshold(brightness) * profile.max()
    top = np.array(profile.shape) - 1
    pixel = np.clip(np.floor(np.asarray(position) + 0.5).astype(int), 0, top)
    lit = profile > threshold
    low, high = np.zeros(2, int), np.zeros(2, int)
    for axis in (0, 1):
        along = np.flatnonzero(lit.any(axis=1 - axis))
        first, last = (along[0], along[-1]) if len(along) else (pixel[axis], pixel[axis])
        low[axis] = max(min(first, pixel[axis] - SMALLEST_RADIUS_PX), 0)
        high[axis] = min(max(last, pixel[axis] + SMALLEST_RADIUS_PX), top[axis])
    return low, high - low + 1, pixel - low


def component_box(start, i, frame, brightness):
    """`box_around` of a component that a start has found, and its profile there (ny, nx), max = 1.

    start: StartingPoint; i: which component; frame (2,) [px]: the frame's shape
    """
    middle, half = start.reach(i, box_threshold(brightness))
    place, top = start.positions[start.source[i]], np.array(frame)
    low = np.minimum(middle - half, place - SMALLEST_RADIUS_PX) - 1
    high = np.maximum(middle + half, place + SMALLEST_RADIUS_PX) + 2
    low = np.maximum(low, 0).astype(int)
    high = np.minimum(np.ceil(high), top).astype(int)
    image = start.drawn(i, low, high - low)
    inside, size, center = box_around(image, place - low, brightness)
    return low + inside, size, center, image[box_slices(inside, size)]


def resize_boxes(scene: Scene, state: State, start, noise) -> tuple[Scene, State]:
    """Scene and state in boxes that fit the present morphologies; themselves where all of them do.

    start: StartingPoint, whose profiles are expected; noise (C,): of a model pixel. What the state
    holds of a box moves along: new pixels start at the profile, with z and all that the update
    remembers at 0.
    """
    boxes = [_box(scene, state, i, start, noise) for i in range(len(state.morph))]
    if all(_same(scene, i, box) for i, box in enumerate(boxes)):
        return scene, state

    fill = [start.drawn(i, low, high - low) for i, (low, high) in enumerate(boxes)]

    def move(arrays, fill=None):
        """Arrays of all sources in their new boxes."""
        return [
            _moved(a, o, low, high, None if fill is None else fill[i])
            for i, (a, o, (low, high)) in enumerate(zip(arrays, scene.origin, boxes, strict=True))
        ]

    origin, memory = np.array([low for low, _ in boxes]), state.memory
    if memory is not None:
        memory = replace(memory, morph=[move(arrays) for arrays in memory.morph])
    return (
        replace(
            scene,
            origin=origin,
            center=scene.center + scene.origin - origin,
            profile=move(scene.profile, fill),
        ),
        replace(
            state,
            morph=move(state.morph, fill),
            latent=move(state.latent),
            memory=memory,
        ),
    )


def _box(scene, state, i, start, noise):
    """First and one-past-last pixel (2,) of the box that source i should have."""
    morph, low = state.morph[i], np.array(scene.origin[i])
    high = low + morph.shape
    if scene.fixed[i]:
        return low, high
    brightness = (state.spectra[i] * morph.max() / noise).max()
    wanted, size, *_ = component_box(start, i, scene.unpadded_shape, brightness)
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
            new_high[axis] = min(high[axis] + GROW_PX, scene.unpadded_shape[axis])
        elif high[axis] - last >= TRIM_PX:
            new_high[axis] = last
    return new_low, new_high


def _same(scene, i, box):
    """Returns True if source i has this box already."""
    low, high = box
    shape = scene.profile[i].shape
    return np.array_equal(low, scene.origin[i]) and np.array_equal(high - low, shape)


def _moved(array, origin, low, high, fill):
    """The array of a box at `origin`, in the box from `low` to `high`; new pixels from `fill`."""
    out = np.zeros(high - low, array.dtype) if fill is None else fill.astype(array.dtype)
    here, there = intersect_boxes(low, high - low, origin, array.shape)
    out[here] = array[there]
    return out
