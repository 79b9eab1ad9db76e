"""Morphologies of many shapes, and what a constraint makes of them on a device."""

import numpy as np
import pytest

from clresample.deblending.solver.boxes import Boxes
from clresample.paper.solver.constraints import MonotoneWeights

# Odd, even, non-square, thin, one pixel; centres in the middle, off it, on edges and in corners.
SHAPES = [(21, 21), (12, 17), (17, 12), (9, 9), (8, 13), (1, 1), (1, 7), (6, 1), (2, 2), (30, 5)]
CENTERS = [(10, 10), (5, 8), (9, 3), (0, 4), (7, 12), (0, 0), (0, 2), (5, 0), (1, 0), (29, 2)]
KINDS = [MonotoneWeights.ANGLE, MonotoneWeights.FLAT, MonotoneWeights.NEAREST]
DTYPES = [np.float32, np.float64]


def many_boxes():
    """A box of each shape, in four scenes."""
    n = len(SHAPES)
    return Boxes(np.arange(n) // 3, np.full((n, 2), -4), np.array(SHAPES), np.array(CENTERS))


def morphologies(boxes, dtype, seed=5):
    """A galaxy with a neighbour in noise for each box."""
    rng = np.random.default_rng(seed)
    images = []
    for shape, center in zip(boxes.shape, boxes.center, strict=True):
        y, x = np.indices(shape) - center[:, None, None]
        image = np.exp(-np.hypot(y, 1.3 * x + 0.2 * y) / 3) + 0.5 * np.exp(-np.hypot(y - 5, x - 4))
        images.append((image + 0.1 * rng.normal(size=shape)).astype(dtype))
    return images


def apply(device, prox, boxes, images, dtype=np.float32, **options):
    """Results of the operator for images on the device."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    flat = device.put(boxes.pack(images, dtype=dtype))
    prox.prox(flat, boxes.put(device), **options)
    return boxes.unpack(device.get(flat))


def eps(dtype, image):
    return 16 * np.finfo(dtype).eps * max(1, abs(image).max())
