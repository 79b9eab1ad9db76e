"""Constraints by one work-item a source and by groups of them.

Each pixel counts, and the largest is found wherever it lies; nothing beyond the boxes is written
or read.
"""

import numpy as np
import pytest
from helpers.buffers import Guards, fill_with_nan
from helpers.morphologies import KINDS, apply, eps, many_boxes, morphologies
from helpers.tuning import tune
from test_constraints import CASES

from clresample.deblending.solver.boxes import Boxes
from clresample.paper.solver import reference as ref
from clresample.paper.solver.constraints import (
    L0,
    L1,
    MaxNorm,
    Monotone,
    Positivity,
    ProxChain,
    SumNorm,
    Symmetry,
)

GROUPS = 1, 64
SHAPE, CENTER = (17, 19), (6, 11)  # more pixels than four for each work-item of a group


@pytest.fixture
def in_groups(device, monkeypatch):
    """Runs a function with each number of work-items a source, watching all buffers."""

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
