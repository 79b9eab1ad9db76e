"""Boxes: their places in the flat buffer, and what is refused."""

import numpy as np
import pytest

from clresample.deblending.solver.boxes import Boxes

SHAPES = [(21, 21), (12, 17), (1, 1), (1, 7), (6, 1), (30, 5)]
CENTERS = [(10, 10), (5, 8), (0, 0), (0, 2), (5, 0), (29, 2)]


@pytest.fixture
def boxes():
    n = len(SHAPES)
    return Boxes(np.arange(n) // 3, np.full((n, 2), -4), np.array(SHAPES), np.array(CENTERS))


def test_boxes_do_not_overlap(boxes):
    flat = boxes.pack([np.full(shape, i + 1) for i, shape in enumerate(SHAPES)])
    for i, view in enumerate(boxes.unpack(flat)):
        assert (view == i + 1).all()
    assert np.count_nonzero(flat) == sum(ny * nx for ny, nx in SHAPES)
    assert (boxes.table[:, 7] * 16 == boxes.offset).all()
    assert boxes.size % 16 == 0
    np.testing.assert_array_equal(boxes.table[:, 3:5], SHAPES)
    np.testing.assert_array_equal(boxes.table[:, 5:7], CENTERS)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Boxes([0], [[0, 0]], [[3, 4]], [[3, 0]]), r"center is \[3, 0\].*\(3, 4\)"),
        (lambda: Boxes([0], [[0, 0]], [[3, 0]]), r"shape is \[3, 0\]"),
        (lambda: Boxes([0, 1], [[0, 0]], [[3, 3]]), "origin has 1 boxes, scene has 2"),
        (lambda: Boxes([0], [[0.5, 0]], [[3, 3]]), "origin is of type float64"),
        (lambda: Boxes([-1], [[0, 0]], [[3, 3]]), "scene is -1"),
        (lambda: Boxes([0], [[0, 0]], [[3, 3]]).pack([np.zeros((2, 3))]), r"\(2, 3\).*\(3, 3\)"),
        (lambda: Boxes([0], [[0, 0]], [[3, 3]]).unpack(np.zeros(9)), r"\(9,\).*\(16,\)"),
    ],
)
def test_wrong_boxes_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
