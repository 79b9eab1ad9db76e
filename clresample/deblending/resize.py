"""Resizes boxes to the light: grown where it reaches their edge, trimmed where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..sky.extent import box_slices, intersect_boxes
from .solver.scene import Scene, State

# [noise of a model pixel] Brightness of a source at the edge of its box. Smaller values make larger
# boxes, which cost time and add no detectable light.
BOX_NOISE = 0.1
# Smallest and largest threshold, as fractions of the profile's peak: the first is the rounding of
# the PSF in float32, the second keeps the profile of a hardly detected source in its box.
BOX_FAINTEST, BOX_BRIGHTEST = 1e-7, 5e-3
# [px] Boxes reach at least this far from their centre, however faint the source.
SMALLEST_RADIUS_PX = 5
# [px] Growth of a side reached by light, and smallest trim of a side: each change of a box requires
# a new engine.
GROW_PX, TRIM_PX = 8, 4
# A side grows when a pixel of its edge is brighter than this many times BOX_NOISE.
GROW_AT = 4.0


def box_threshold(brightness):
    """Fraction of a profile's peak at the edge of its box.

    brightness: the peak over the noise of a model pixel. A pixel belongs to the box if the profile,
        or the prior's scatter of structure there, reaches BOX_NOISE of the noise. With alpha = 0.1
        that scatter is 0.1 sqrt(profile) of the peak, so the threshold on the profile is
        brightness^-2
    """
    brightness = max(brightness, 1.0)
    return np.clip(min(BOX_NOISE / brightness, brightness**-2), BOX_FAINTEST, BOX_BRIGHTEST)


def box_around(profile, position, brightness):
    """Box of one profile: origin (2,) and shape (2,) inside the frame, and its centre pixel (2,).

    profile (Ny, Nx): over the frame; position (2,) [px]; brightness: its peak over the noise of a
        model pixel, in the channel with the highest signal to noise
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
    """`box_around` for a component of a start, and its profile in that box (ny, nx), max = 1.

    start: StartingPoint; i: index of the component; frame (2,) [px]: the frame's shape
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
    """Scene and state in boxes resized to the present morphologies; unchanged if no box changes.

    start: StartingPoint with the expected profiles; noise (C,): of a model pixel. Arrays of the
        state are copied to the new boxes: new pixels start at the profile, with z and all moments
        at 0.
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
