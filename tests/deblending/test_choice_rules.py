"""Methods of rendering sources: groups by cells, counted operations, windows that save."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.solver.boxes import Boxes
from clresample.deblending.solver.rendering import stage_selection
from clresample.deblending.solver.rendering.windows import ROUND_PX, WindowGroups, WindowOperator
from clresample.device.contraction import COLUMN_PAD


def boxes_at(*places, scene=None, n=8):
    count = len(places)
    return Boxes(
        np.zeros(count, int) if scene is None else np.array(scene),
        np.array(places),
        np.full((count, 2), n),
    )


def test_groups_are_of_the_cells_that_hold_the_middles_of_boxes():
    """Of those that are meant, by scene; frames of one size, multiples of 16, about all of each."""
    boxes = boxes_at((0, 0), (5, 9), (7, 12), (40, 3), (0, 0), (3, 3), scene=[0, 0, 0, 0, 1, 1])
    groups = WindowGroups(boxes, np.array([0, 1, 2, 3, 4]), np.array([10, 16]))
    assert ROUND_PX == 16 and len(groups) == 4
    assert groups.group.tolist() == [0, 0, 1, 2, 3, 0] and groups.scene.tolist() == [0, 0, 0, 1]
    assert groups.low.tolist() == [[0, 0], [7, 12], [40, 3], [0, 0]]
    assert groups.shape.tolist() == [16, 32]  # 13 x 17 pixels of the first
    exact = WindowGroups(boxes_at((0, 0), (8, 8)), np.arange(2), np.array([50, 50]))
    assert exact.shape.tolist() == [16, 16] and exact.low.tolist() == [[0, 0]]


class Host:
    """A device whose arrays are NumPy's."""

    def put(self, values, dtype=None):
        return np.array(values, dtype)


def test_groups_take_the_place_of_scenes():
    """Each source lies in its group's frame as in its scene's; kernels find those of a group in a
    list, in which sources that are not meant are left out."""
    boxes = boxes_at((41, 5), (3, 30), (7, 12), (40, 3), (2, 1), (30, 3), scene=[0, 0, 0, 0, 1, 1])
    boxes = Boxes(boxes.scene, boxes.origin, boxes.shape, np.tile([2, 5], (6, 1)))
    groups = WindowGroups(boxes, np.array([0, 2, 3, 4, 5]), np.array([25, 100]))
    batch = SimpleNamespace(host_boxes=boxes, scenes=["a", "b"], device=Host(), spectra="kept")
    found = groups.buffers(batch)
    assert found.scenes == ["a", "a", "b", "b"] and found.spectra == "kept"
    assert batch.scenes == ["a", "b"] and batch.host_boxes is boxes  # that one stays as it is
    assert found.all_sources.tolist() == [0, 2, 3, 4, 5]
    assert found.first.tolist() == [0, 1, 3, 4, 5] and found.order.tolist() == [2, 0, 3, 4, 5]
    assert {a.dtype for a in (found.all_sources, found.first, found.order)} == {np.dtype(np.int32)}
    own = found.host_boxes
    assert own.scene[[0, 2, 3, 4, 5]].tolist() == [1, 0, 1, 2, 3]
    origin = [[1, 2], [0, 0], [0, 0], [0, 0], [0, 0]]
    assert own.origin[[0, 2, 3, 4, 5]].tolist() == origin
    assert own.center.tolist() == boxes.center.tolist()


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -2.3)])
def test_windows_lie_where_the_observation_sees_their_frames(shift):
    """To a pixel; what is left of a pixel and of the shift moves the transfer function."""
    c, s = 1.7 * np.cos(0.5), 0.8 * np.sin(0.5)
    turned = np.array([[c, -s], [s, c]])
    at = SimpleNamespace(matrix=turned, offset=np.array([-3.2, 5.9]))
    small = SimpleNamespace(matrix=turned, offset=np.array([-11.3, -8.4]))
    one, moves = object.__new__(WindowOperator), []
    one.op = SimpleNamespace(plans=[SimpleNamespace(mapping=at)], shift=np.array(shift))
    one.plan = SimpleNamespace(mapping=small, shifted=lambda move: move)
    one._groups = SimpleNamespace(low=np.array([[0, 0], [40, 3], [17, 60]]))
    one._executor = SimpleNamespace(set_transfer=moves.extend)
    one.place()
    for low, move, group in zip(one.low, moves, one._groups.low, strict=True):
        pixel = np.array([4, 9])  # of the observation: where it lies on the model, by either way
        wanted = turned @ pixel + at.offset + shift
        found = turned @ (pixel - low) + small.offset + move + group
        np.testing.assert_allclose(found, wanted)
        assert np.abs(np.linalg.solve(turned, move)).max() <= 0.5


def test_the_cheapest_of_all_sizes_of_cells_is_taken(monkeypatch):
    matrix = np.array([[2.0, -1.0], [0.5, 4.0]])
    op = SimpleNamespace(
        shape_in=(3, 120, 240), plans=[SimpleNamespace(mapping=SimpleNamespace(matrix=matrix))]
    )

    def cost(boxes, op, cell, inverse):
        np.testing.assert_allclose(inverse, np.abs(np.linalg.inv(matrix)))
        return abs(cell[0] - 15) + abs(cell[1] - 30) + 7

    monkeypatch.setattr(stage_selection, "WindowGroups", lambda boxes, which, cell: cell)
    monkeypatch.setattr(stage_selection, "_window_flops", cost)
    count, cell = stage_selection._best_groups(SimpleNamespace(host_boxes=None), op, np.arange(3))
    assert count == 7 and cell.tolist() == [15, 30]


def test_operations_are_counted_from_sizes():
    """Products of matrices, four operations a term and pair; weighed sums at points beside them."""
    shape, (n_y, n_x, k_y, k_x) = np.array([[3, 5], [4, 2]]), (20, 30, 16, 48)
    of_frame, of_box = np.tile([k_y, k_x], (2, 1)), np.tile([k_y, k_x], (2, 1))
    found = stage_selection._counts(shape, 3, n_y, n_x, of_frame, of_box)
    rows, pixels, n_images = 7, 23, 6
    second = n_images * k_y * n_y * k_x
    wanted = [
        n_images * n_y * n_x * k_x + second + stage_selection.SUM_COST * 1.5 * 3 * pixels,
        stage_selection.BOX_COST * pixels * k_x
        + second
        + stage_selection.SUM_COST * 1.5 * 3 * rows * k_x,
        stage_selection.BOX_COST * (pixels * k_x + rows * k_y * k_x)
        + stage_selection.SUM_COST * 1.5 * 3 * 2 * k_y * k_x,
    ]
    np.testing.assert_allclose(found, 4 * np.array(wanted))
    # each frame, and each box in it, has waves of its own
    of_frame, of_box = np.array([[4, 32], [6, 16]]), np.array([[6, 16], [4, 32]])
    first, second = 3 * 20 * 30 * (32 + 16), 3 * 20 * (4 * 32 + 6 * 16)
    to_lines, to_planes = 15 * 16 + 8 * 32, 3 * 6 * 16 + 4 * 4 * 32
    by_pixel, by_line, by_wave = 23, 3 * 16 + 4 * 32, 6 * 16 + 4 * 32
    wanted = [
        first + second + stage_selection.SUM_COST * 4.5 * by_pixel,
        stage_selection.BOX_COST * to_lines + second + stage_selection.SUM_COST * 4.5 * by_line,
        stage_selection.BOX_COST * (to_lines + to_planes)
        + stage_selection.SUM_COST * 4.5 * by_wave,
    ]
    found = stage_selection._counts(shape, 3, 20, 30, of_frame, of_box)
    np.testing.assert_allclose(found, 4 * np.array(wanted))
    plain, lines = SimpleNamespace(lines=None), SimpleNamespace(lines=1)
    assert stage_selection._observed(plain, 5, 7, 11, 13) == 5 * 11 * 13 + 5 * 13 * 7
    assert stage_selection._observed(lines, 5, 7, 11, 13) == 11 * 13 * 7 + 11 * 7 * 5


@pytest.mark.parametrize("axes", [[0, 1], [1, 0]])
def test_operations_are_those_of_an_executors_plans(axes, monkeypatch):
    """One for all scenes, or one each; their waves along x are padded to whole vectors."""
    monkeypatch.setattr(stage_selection, "_counts", lambda *given: given)
    boxes = SimpleNamespace(shape=np.array([[3, 5], [4, 2], [6, 7]]), scene=np.array([0, 0, 1]))
    buffers = SimpleNamespace(host_boxes=boxes, scenes=[0, 1])
    op = SimpleNamespace(shape_in=(3, 40, 50))
    for k_ys, k_xs in (([11], [17]), ([11, 9], [17, 33])):
        executor = SimpleNamespace(
            axes=axes, n_y=40, n_x=50, k_ys=np.array(k_ys), k_xs=np.array(k_xs)
        )
        shape, *sizes, of_frame, of_box = stage_selection.stage_flops(buffers, op, executor)
        np.testing.assert_array_equal(shape, boxes.shape[:, axes])
        assert sizes == [3, 40, 50]
        waves = np.stack([np.array(k_ys), -(-np.array(k_xs) // COLUMN_PAD) * COLUMN_PAD], axis=1)
        np.testing.assert_array_equal(of_frame, waves[[0, -1]])
        np.testing.assert_array_equal(of_box, waves[[0, 0, -1]])


@pytest.mark.parametrize("axes", [(0, 1), (1, 0)])
@pytest.mark.parametrize("lines", [None, True, False])
def test_operations_in_windows_are_those_of_smaller_frames(axes, lines, monkeypatch):
    """Frequencies and columns shrink with the frame and its reach; what is observed is what a
    window shows, of pixels half as large along y and of a third along x."""
    executor = SimpleNamespace(axes=axes, n_y=100, n_x=80, k_y=60, k_x=50, n_columns=70)
    plan = SimpleNamespace(
        lines=None if lines is None else SimpleNamespace(by_row=lines),
        mapping=SimpleNamespace(matrix=np.diag([1 / 2, 1 / 3])),
    )
    reach = 5
    monkeypatch.setattr(stage_selection, "reach_of", lambda _: reach)
    op = SimpleNamespace(executor=lambda: executor, plans=[plan], shape_out=(3, 9, 9))
    boxes = boxes_at((9, 9), (0, 0), (3, 10), (40, 3), n=8)
    groups = WindowGroups(boxes, np.array([1, 2, 3]), np.array([10, 20]))
    n_y, n_x = groups.shape[list(axes)]
    assert len(groups) == 2 and groups.shape.tolist() == [16, 32]
    k_y, k_x = 60 * (n_y + 2 * reach) / (100 + reach), 50 * (n_x + 2 * reach) / (80 + reach)
    along_y, along_x = 2 * (16 + 2 * reach), 3 * (32 + 2 * reach)
    if lines is None:
        observed = along_y * k_x * (k_y + along_x)
    else:
        n_columns = 70 * (n_x + 2 * reach) / 80
        observed = k_y * n_columns * (k_x + (along_y if lines else along_x))
    waves = np.tile([k_y, k_x], (3, 1))
    counts = stage_selection._counts(np.full((3, 2), 8), 3, n_y, n_x, waves[:2], waves)
    found = stage_selection._window_flops(boxes, op, groups, np.diag([2.0, 3.0]))
    assert found == pytest.approx(min(counts) + 4 * 2 * 3 * observed)


def parts_of(monkeypatch, sides, cost, *, count=1000.0, n_plans=1, n_terms=1, geometry="affine"):
    """The sources of each part that is rendered in windows, which cost as much as `cost` of their
    indices says; None without windows. Frames of 200 pixels, 3 images of 25 operations more."""
    executor = SimpleNamespace(n_rows=1, n_columns=2, k_y=3, k_x=4)
    op = SimpleNamespace(
        plans=[None] * n_plans,
        n_terms=n_terms,
        geometry=geometry,
        shape_in=(3, 200, 200),
        shape_out=(3, 9, 9),
        executor=lambda: executor,
    )
    boxes = SimpleNamespace(shape=np.array([(n, n) for n in sides]))
    monkeypatch.setattr(stage_selection, "reach_of", lambda _: 30)
    monkeypatch.setattr(
        stage_selection, "_observed", lambda *given: 25.0 if given[1:] == (1, 2, 3, 4) else 0
    )
    monkeypatch.setattr(
        stage_selection, "_best_groups", lambda b, o, which: (cost(which.tolist()), which.tolist())
    )
    buffers = SimpleNamespace(host_boxes=boxes, scenes=[0])
    return stage_selection._parts(buffers, op, count)


def test_windows_are_taken_where_they_save_most(monkeypatch):
    """For 0.4 of all operations at most; boxes far larger than the median's may have their own."""
    assert stage_selection.MAX_WINDOW_COST == 0.4 and stage_selection.LARGE.tolist() == [
        1.3,
        1.6,
        2.0,
    ]
    few, limit = [20] * 4, 0.4 * (1000 + 4 * 3 * 25)
    everyone = [[0, 1, 2, 3]]
    assert parts_of(monkeypatch, few, lambda _: limit - 1) == everyone
    assert parts_of(monkeypatch, few, lambda _: limit + 1) is None
    for given in ({"n_plans": 2}, {"n_terms": 2}, {"geometry": "distorted"}):
        assert parts_of(monkeypatch, few, lambda _: 1.0, **given) is None
    assert parts_of(monkeypatch, [40] * 3, lambda _: 1.0) == [[0, 1, 2]]  # 40 + 2 x 30 = 200 / 2
    assert parts_of(monkeypatch, [41] * 3, lambda _: 1.0) is None
    sides = [20] * 5 + [25, 31, 39, 41]
    for n in (6, 7, 8):
        costs = {n: 10.0, 9 - n: 20.0}
        found = parts_of(monkeypatch, sides, lambda which, c=costs: c.get(len(which), 300.0))
        assert found == [list(range(n)), list(range(n, 9))]
    costs = {9: 100.0}
    found = parts_of(monkeypatch, sides, lambda which: costs.get(len(which), 51.0))
    assert found == [list(range(9))]
