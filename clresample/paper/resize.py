"""Resizes boxes to the light: grown where it reaches their edge, trimmed where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..deblending.start.boxes import BOX_NOISE, component_box
from ..sky.box import intersect_boxes
from .solver.scene import AmsgradScene, AmsgradState

# [px] Growth of a side reached by light, and smallest trim of a side: each change of a box requires
# a new engine.
GROW_PX, TRIM_PX = 8, 4
# A side grows when a pixel of its edge is brighter than this many times BOX_NOISE.
GROW_AT = 4.0


def resize_boxes(
    scene: AmsgradScene, state: AmsgradState, start, noise
) -> tuple[AmsgradScene, AmsgradState]:
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
