"""Constraints by one work-item a source and by groups of them: each pixel counts, the largest
wherever it lies; nothing beyond the boxes is written or read."""

import numpy as np
import pytest
from helpers.buffers import Guards, fill_with_nan
from helpers.morphologies import KINDS, apply, eps, many_boxes, morphologies
from helpers.tuning import tune
from test_constraints import CASES

from clresample import DeviceError
from clresample.deblending.solver.boxes import ALIGN, Boxes
from clresample.paper.solver import reference as ref
from clresample.paper.solver.constraints import (
    L0,
    L1,
    MaxNorm,
    Monotone,
    MonotoneProjection,
    Positivity,
    ProxChain,
    SumNorm,
    Symmetry,
)
from clresample.paper.solver.prox_launches import most_iterations

GROUPS = 1, 64
SHAPE, CENTER = (17, 19), (6, 11)  # more pixels than four for each work-item of a group


@pytest.fixture
def in_groups(device, monkeypatch):
    """Run a function with each number of work-items a source, watching all buffers."""

    def run(check):
        for group in GROUPS:
            with monkeypatch.context() as patch:
                tune(patch, sum_group=group)
                fill_with_nan(patch)
                guards = Guards(patch)
                check(device)
                assert guards.overwritten() == []

    return run


def test_all_steps_answer_as_their_references(in_groups):
    boxes = many_boxes()
    images = morphologies(boxes, np.float32)

    def check(device):
        for name, (prox, reference) in CASES.items():
            if name in ("chain", "nine steps"):  # made of the others
                continue
            found = apply(device, prox, boxes, images, step=0.3)
            for image, center, got in zip(images, boxes.center, found, strict=True):
                close = eps(np.float32, image)
                np.testing.assert_allclose(got, reference(image, center), rtol=0, atol=close)

    in_groups(check)


def test_sweeps_of_all_weights(in_groups):
    """Boxes of every shape, and of centres beyond each side's middle."""
    boxes = many_boxes()
    images = morphologies(boxes, np.float32)

    def check(device):
        for weights in KINDS:
            for gradient in (0.0, 0.2):
                prox = Monotone(weights=weights, gradient=gradient)
                found = apply(device, prox, boxes, images)
                for image, center, got in zip(images, boxes.center, found, strict=True):
                    wanted = ref.monotone_sweep(image, center, weights, gradient)
                    np.testing.assert_allclose(got, wanted, rtol=0, atol=eps(np.float32, image))

    in_groups(check)


def test_projections_of_groups_are_those_of_one(in_groups):
    """Which test_monotone.py compares with the reference."""
    boxes, found = many_boxes(), []
    images = morphologies(boxes, np.float32)

    def check(device):
        for weights in KINDS:
            prox = MonotoneProjection(
                weights=weights, gradient=0.05, n_iterations=400, tolerance=1e-6
            )
            found.append(apply(device, prox, boxes, images))

    in_groups(check)
    for one, many in zip(found[: len(KINDS)], found[len(KINDS) :], strict=True):
        for a, b in zip(one, many, strict=True):
            assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(a) + 1e-6


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("n_iterations", [0, 30])
def test_projections_in_many_launches_are_those_in_one(device, monkeypatch, group, n_iterations):
    """A device that ends long loops gets few iterations a launch, and answers as any other; some
    sources come to their end in an early launch, others in none."""
    boxes = many_boxes()
    images = morphologies(boxes, np.float32)
    prox = {"n_iterations": n_iterations, "tolerance": 2e-2}
    tune(monkeypatch, sum_group=group, max_loop_iterations=None)
    whole = apply(device, MonotoneProjection(**prox), boxes, images)
    largest = max(-(-(y + 2) * (x + 2) // ALIGN) * ALIGN for y, x in boxes.shape.tolist())
    for loops in (65535, 8 * (largest // group + 2) + 2 * group, 20 * (largest // group + 2)):
        tune(monkeypatch, max_loop_iterations=loops)
        parts = apply(device, MonotoneProjection(**prox), boxes, images)
        for a, b in zip(whole, parts, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_launch_of_the_projection_makes_no_more_loops_than_allowed(device):
    """Counted one by one: each loop's iterations, and the look that ends it."""
    for group, n, loops in ((1, 240, 65535), (64, 240, 4000), (64, 10624, 65535), (1, 16, 300)):
        most, walk = most_iterations(device, n, group, loops), -(-n // group) + 1
        inner = -(-n // (4 * group)) + 1 + (group if group > 1 else 0)

        def made(turns, walk=walk, inner=inner):
            return 4 * walk + inner + turns * (1 + 2 * walk) + turns // 4 * 2 * inner + 1

        assert most >= 1 and made(most) <= loops
        assert made(most + 9) > 0.9 * loops  # nor much less
    with pytest.raises(DeviceError, match="after 65535 iterations, .* 700000 pixels: use smaller"):
        most_iterations(device, 700_000, 64, 65535)


def test_large_boxes_are_projected_to_their_end(device):
    """With the groups that the device has: more loops than Mesa's llvmpipe allows one launch."""
    box = Boxes([0], [[0, 0]], [[121, 119]], [[60, 55]])
    y, x = np.indices((121, 119)) - np.array([60, 55])[:, None, None]
    noise = np.random.default_rng(3).normal(size=y.shape)
    image = (np.exp(-np.hypot(y, x) / 20) + 0.1 * noise).astype(np.float32)
    given = {"n_iterations": 150, "tolerance": 0.0}
    (found,) = apply(device, MonotoneProjection(**given), box, [image])
    wanted, _ = projected(
        image.astype(float), (60, 55), KINDS[0], 0, positive=True, dual=np.zeros(y.shape), **given
    )
    wanted = ref.monotone_sweep(wanted, (60, 55), KINDS[0], 0)
    assert np.linalg.norm(found - wanted) <= 1e-4 * np.linalg.norm(wanted)


def one_each():
    """A box for each pixel of SHAPE, in which that pixel alone is 3, the others `rest`."""
    n = SHAPE[0] * SHAPE[1]
    boxes = Boxes(np.zeros(n, int), np.zeros((n, 2), int), np.array([SHAPE] * n), [CENTER] * n)
    return boxes, np.eye(n).reshape(n, *SHAPE)


def test_each_pixel_alone(in_groups):
    boxes, unit = one_each()

    def check(device):
        for prox, wanted in (
            (MaxNorm(), (4 * unit - 1) / 3),  # of 3 among -1
            (SumNorm(), unit),
            (Positivity(), 3 * unit),
            (L1(0.5), 2.5 * unit),
            (L0(0.5), 3 * unit),
        ):
            below = -1 if isinstance(prox, MaxNorm | Positivity) else 0
            images = list(((3 - below) * unit + below).astype(np.float32))
            found = np.array(apply(device, prox, boxes, images))
            np.testing.assert_allclose(found, wanted, atol=1e-6)
        found = np.array(apply(device, Symmetry(), boxes, list(2 * unit.astype(np.float32))))
        for image, got in zip(2 * unit, found, strict=True):
            np.testing.assert_array_equal(got, ref.symmetry(image, CENTER))

    in_groups(check)


def test_what_norms_leave_alone(in_groups):
    """Images of nothing, or less: no division, and a factor of 1."""
    boxes, unit = one_each()
    images = [np.zeros(SHAPE, np.float32), -unit[3].astype(np.float32)] * 2
    four = Boxes(boxes.scene[:4], boxes.origin[:4], boxes.shape[:4], boxes.center[:4])

    def check(device):
        for prox in (SumNorm(), MaxNorm(), ProxChain(SumNorm(), MaxNorm())):
            factor = device.put(np.full(4, 7, np.float32))
            found = apply(device, prox, four, images, factor=factor, active=[0, 1, 3])
            np.testing.assert_array_equal(found, images)
            np.testing.assert_array_equal(device.get(factor), [1, 1, 7, 1])

    in_groups(check)


def test_thresholds_are_exclusive_and_inclusive_as_they_say(in_groups):
    """|x| at the soft threshold becomes 0; x^2 at the hard one 0, above it x; strength 0 keeps."""
    boxes = Boxes([0], [[0, 0]], [[1, 7]])
    image = np.array([[-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0]], np.float32)

    def check(device):
        (soft,) = apply(device, L1(1.0), boxes, [image], step=1.0)
        np.testing.assert_array_equal(soft, [[-1, 0, 0, 0, 0, 0, 1]])
        (hard,) = apply(device, L0(0.5), boxes, [image], step=1.0)
        np.testing.assert_array_equal(hard, [[-2, 0, 0, 0, 0, 0, 2]])
        for prox in (L0(0.0), L1(0.0), Symmetry(0.0)):
            (same,) = apply(device, prox, boxes, [image], step=1.0)
            np.testing.assert_array_equal(same, image)

    in_groups(check)


def projected(y, center, weights, gradient, *, positive, n_iterations, tolerance, dual):
    """What project.cl says it does, in float64; from a dual image on, the next one too."""
    w = ref.monotone_weights(y.shape, center, weights) * (1 - gradient)
    inside = np.ones(y.shape)
    inside[tuple(center)] = 0
    tau = inside / np.maximum(ref._rows(w, ref._columns(w, inside, 1), 1), 1)
    low = 0 if positive else -np.inf
    ahead, momentum = dual, 1.0
    for k in range(1, n_iterations + 1):
        z = np.maximum(y - ref._columns(w, ahead, -1), low)
        ascent = ref._rows(w, z, -1)
        new = np.maximum(0, ahead + tau * ascent)
        before, momentum = momentum, (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        move = new - dual
        ahead, dual = new + (before - 1) / momentum * move, new
        if k % 4 == 0:
            if (ascent * move).sum() < 0:
                momentum = 1.0
            if (move**2).sum() <= tolerance**2 * (y**2).sum():
                break
    return np.maximum(y - ref._columns(w, dual, -1), low), dual


def test_projections_step_by_step(in_groups):
    """Momentum, its end, and the end of the iteration; a second call goes on from the first."""
    boxes = many_boxes()
    images = morphologies(boxes, np.float32)

    def check(device):
        for n_iterations, tolerance, positive in ((1, 0, True), (7, 0, False), (30, 2e-2, True)):
            given = {"n_iterations": n_iterations, "tolerance": tolerance, "positive": positive}
            prox, placed = MonotoneProjection(gradient=0.05, **given), boxes.put(device)
            duals = [np.zeros(image.shape) for image in images]
            for _ in range(2):
                flat = device.put(boxes.pack(images, dtype=np.float32))
                prox.prox(flat, placed)
                found = boxes.unpack(device.get(flat))
                for i, (image, center) in enumerate(zip(images, boxes.center, strict=True)):
                    wanted, duals[i] = projected(
                        image.astype(float), center, KINDS[0], 0.05, dual=duals[i], **given
                    )
                    wanted = ref.monotone_sweep(wanted, center, KINDS[0], 0.05)  # feasible
                    np.testing.assert_allclose(found[i], wanted, rtol=0, atol=2e-6)

    in_groups(check)
