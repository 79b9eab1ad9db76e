"""Monotone morphologies: the sweep and the projection, against their references."""

import numpy as np
import pytest
from helpers.morphologies import DTYPES, KINDS, apply, eps, many_boxes, morphologies
from helpers.tuning import tune
from scipy.optimize import nnls

from clresample.deblending.solver.boxes import Boxes
from clresample.paper.solver import reference as ref
from clresample.paper.solver.constraints import (
    MaxNorm,
    Monotone,
    MonotoneProjection,
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
    for prox in (
        lambda: ProxChain(Symmetry(), Monotone(gradient=0.1), SumNorm(), MaxNorm()),
        lambda: MonotoneProjection(weights=MonotoneWeights.FLAT),
    ):
        tune(monkeypatch, sum_group=64)
        many = apply(device, prox(), boxes, images)
        tune(monkeypatch, sum_group=1)
        for a, b in zip(many, apply(device, prox(), boxes, images), strict=True):
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


def exact_projection(y, center, weights, gradient, positive):
    """By the dual, min |B^T l (- m) - y| with l, m >= 0, solved by active sets: exact, and slow."""
    n = y.size
    rows = [
        ref.monotone_violation(unit.reshape(y.shape), center, weights, gradient).ravel()
        for unit in np.eye(n)
    ]  # column j of B is B e_j, so this is B^T
    matrix = np.array(rows)
    if positive:
        matrix = np.hstack([matrix, -np.eye(n)])
    dual, _ = nnls(matrix, y.ravel())
    return (y.ravel() - matrix @ dual).reshape(y.shape)


@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("weights", KINDS)
def test_projection_is_exact(device, boxes, weights, positive):
    """Reference against active sets, device against reference."""
    images = morphologies(boxes, np.float64)
    prox = MonotoneProjection(
        weights=weights, gradient=0.05, positive=positive, n_iterations=5000, tolerance=1e-7
    )
    found = apply(device, prox, boxes, images, np.float32)
    for image, center, got in zip(images, boxes.center, found, strict=True):
        want, bound = ref.monotone_projection(image, center, weights, 0.05, positive=positive)
        assert bound <= 1e-7 * np.linalg.norm(image)
        # float32, and an iteration that stops some 100 moves of 1e-7 before the end
        assert np.linalg.norm(got - want) <= 2e-5 * np.linalg.norm(image)
        if image.size < 100:
            exact = exact_projection(image, center, weights, 0.05, positive)
            np.testing.assert_allclose(want, exact, rtol=0, atol=1e-6)


def test_projection_as_given_is_near(device):
    """The default iterations and tolerance reach the error that the class states, in much noise."""
    box = Boxes([0], [[0, 0]], [[41, 41]])
    y, x = np.indices((41, 41)) - 20
    noise = np.random.default_rng(8).normal(size=(41, 41))
    image = (np.exp(-np.hypot(y, 1.3 * x + 0.2 * y) / 4) + 0.2 * noise).astype(np.float32)
    want, _ = ref.monotone_projection(image.astype(float), (20, 20), tolerance=1e-5)
    (found,) = apply(device, MonotoneProjection(), box, [image])
    assert np.linalg.norm(found - want) <= 1e-4 * np.linalg.norm(image)


def test_projection_goes_on_where_it_stopped(device, boxes):
    """Many short calls on the same image end where one long call does."""
    images = morphologies(boxes, np.float32)
    short = MonotoneProjection(n_iterations=8, tolerance=1e-7)
    placed = boxes.put(device)
    for _ in range(100):
        flat = device.put(boxes.pack(images))
        short.prox(flat, placed)
    found = boxes.unpack(device.get(flat))
    whole = apply(device, MonotoneProjection(n_iterations=5000, tolerance=1e-7), boxes, images)
    for a, b in zip(found, whole, strict=True):
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b) + 1e-6
