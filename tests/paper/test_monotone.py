"""Monotone morphologies: the sweep and the projection, against their references."""

import numpy as np
import pytest
from helpers.morphologies import DTYPES, KINDS, apply, eps, many_boxes, morphologies
from helpers.tuning import tune

from clresample.deblending.solver.boxes import Boxes
from clresample.paper.solver import reference as ref
from clresample.paper.solver.constraints import (
    MaxNorm,
    Monotone,
    MonotoneWeights,
    ProxChain,
    SumNorm,
    Symmetry,
)


@pytest.fixture
def boxes():
    return many_boxes()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("gradient", [0, 0.1])
@pytest.mark.parametrize("weights", KINDS)
def test_monotone_is_the_sequential_sweep(device, boxes, weights, gradient, dtype):
    images = morphologies(boxes, dtype)
    prox = Monotone(weights=weights, gradient=gradient)
    found = apply(device, prox, boxes, images, dtype)
    for image, center, got in zip(images, boxes.center, found, strict=True):
        want = ref.monotone_sweep(image, center, weights, gradient)
        np.testing.assert_allclose(got, want, rtol=0, atol=eps(dtype, image))
        assert ref.monotone_violation(got, center, weights, gradient).max() <= eps(dtype, image)


@pytest.mark.parametrize("group", [1, 64])
@pytest.mark.parametrize("weights", KINDS)
def test_pixels_of_one_level_do_not_see_each_other(device, weights, group, monkeypatch):
    """Work-items of a group write a level's pixels at the same time: a NaN in any of them reaches
    none of the others, though neighbours of weight 0 lie among them."""
    tune(monkeypatch, sum_group=group)
    shape, center = (9, 11), (4, 4)
    box, sweep = Boxes([0], [[0, 0]], [shape], [center]), Monotone(weights=weights)
    y, x = np.indices(shape) - np.array(center)[:, None, None]
    levels = level(y, x)
    image = np.random.default_rng(4).uniform(0.5, 1.5, shape).astype(np.float32)
    (clean,) = apply(device, sweep, box, [image])
    assert (clean < image).sum() > 40
    for planted in zip(*np.nonzero(levels), strict=True):
        broken = image.copy()
        broken[planted] = np.nan
        (found,) = apply(device, sweep, box, [broken])
        same = (levels <= levels[planted]) & ~np.isnan(broken)
        np.testing.assert_array_equal(found[same], clean[same])


def test_groups_of_a_gpu(device, boxes, monkeypatch):
    """64 work-items a source with barriers, whatever the device, answer as one work-item does."""
    images = morphologies(boxes, np.float32)
    found = []
    for group in (64, 1):
        tune(monkeypatch, sum_group=group)
        prox = ProxChain(Symmetry(), Monotone(gradient=0.1), SumNorm(), MaxNorm())
        found.append(apply(device, prox, boxes, images))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=3e-6)


@pytest.mark.parametrize("weights", KINDS)
def test_level_order_is_safe(weights):
    """Every neighbour that counts has a smaller level, and lies nearer to the centre."""
    shape, center = (23, 31), (9, 20)
    y, x = np.indices(shape) - np.array(center)[:, None, None]
    w = ref.monotone_weights(shape, center, weights)
    for weight, (dy, dx) in zip(w, ref.NEIGHBOURS, strict=True):
        assert (level(y + dy, x + dx) < level(y, x))[weight > 0].all()
        assert (np.hypot(y + dy, x + dx) < np.hypot(y, x))[weight > 0].all()
    total = w.sum(0)
    assert total[center] == 0
    np.testing.assert_allclose(np.delete(total.ravel(), 9 * 31 + 20), 1)


def level(y, x):
    return 2 * np.maximum(abs(y), abs(x)) + np.minimum(abs(y), abs(x))


def test_weights_by_hand():
    """At (dy, dx) = (0, 3), in the order of NEIGHBOURS: west, and north-west and south-west."""
    w = {kind: ref.monotone_weights((9, 9), (4, 4), kind)[:, 4, 7] for kind in KINDS}
    np.testing.assert_allclose(w[MonotoneWeights.FLAT], np.array([1, 0, 0, 1, 0, 1, 0, 0]) / 3)
    np.testing.assert_allclose(w[MonotoneWeights.NEAREST], [0, 0, 0, 1, 0, 0, 0, 0])
    root = 0.5**0.5
    want = np.array([root, 0, 0, 1, 0, root, 0, 0]) / (1 + 2 * root)
    np.testing.assert_allclose(w[MonotoneWeights.ANGLE], want)
    edge = ref.monotone_weights((9, 9), (0, 4), MonotoneWeights.FLAT)[:, 0, 7]
    np.testing.assert_allclose(edge, np.array([0, 0, 0, 1, 0, 1, 0, 0]) / 2)  # none from outside
