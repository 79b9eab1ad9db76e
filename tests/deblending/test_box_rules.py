"""Boxes, in tables: sizes by their light, growth and trimming, and refused arguments."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.start import point_of

from clresample.deblending.linear.spectra import spectrum_covariance
from clresample.deblending.solver.boxes import Boxes
from clresample.deblending.start.boxes import box_around, box_threshold, component_box
from clresample.paper.resize import _box, _moved, _same


def test_boxes_hold_a_tenth_of_the_noise():
    """Or what structure of 10 % may be: the square of the brightness; within float32 and 0.5 %."""
    given = [0.0, 5.0, 10.0, 20.0, 1e3, 1e5, 1e9]
    found = [float(box_threshold(b)) for b in given]
    np.testing.assert_allclose(found, [5e-3, 5e-3, 5e-3, 2.5e-3, 1e-6, 1e-7, 1e-7])
    assert box_threshold(15.0) == pytest.approx(1 / 225)


LIT = np.zeros((40, 41))
LIT[[20, 8, 20, 39], [22, 22, 39, 0]] = 1.0, 0.01, 0.006, 0.004


@pytest.mark.parametrize(
    "profile, at, first, end, centre",
    [
        (LIT, (20.0, 22.0), [8, 17], [26, 40], [12, 5]),
        (LIT, (19.5, 22.49), [8, 17], [26, 40], [12, 5]),
        (LIT, (1.0, 38.0), [0, 22], [21, 41], [1, 16]),
        (0 * LIT, (90.0, -7.0), [34, 0], [40, 6], [5, 0]),  # dark, outside
    ],
)
def test_boxes_end_where_light_does(profile, at, first, end, centre):
    """With five pixels about the centre at least; the last pixel that is lit belongs to it."""
    low, size, middle = box_around(profile, at, 1.0)
    assert [[*low], [*(low + size)], [*middle]] == [first, end, centre]


def test_boxes_of_a_start_hold_five_pixels_about_small_sources():
    """To the end of its light if that is nearer, and inside the frame."""
    for place, wanted in (((25, 30), [20, 25, 31, 36]), ((3, 57), [0, 52, 9, 60])):
        image = _spot((50, 60), place, 0.4)
        low, size, centre, part = component_box(point_of(image[None], place), 0, (50, 60), 1.0)
        assert [*low, *(low + size)] == wanted and [*(low + centre)] == [*place]
        np.testing.assert_allclose(part, image[low[0] : wanted[2], low[1] : wanted[3]])


def morph_of(*lit):
    """A morphology (30, 20) with its peak at (15, 10) and pixels (y, x, value) besides."""
    morph = np.zeros((30, 20))
    for y, x, value in [(15, 10, 1.0), *lit]:
        morph[y, x] = value
    return morph


EDGES = [(0, 10), (15, 0), (29, 10), (15, 19)]  # pixels at the edges low y, x and high y, x
GROWN, BOX, NEEDED = (2, 12, 48, 48), (10, 20, 40, 40), (20, 25, 31, 36)
AROUND = [(15, 4, 0.011), (15, 15, 0.011)]


@pytest.mark.parametrize(
    "morph, given, wanted",
    [
        (morph_of(), {"fixed": True}, BOX),
        (morph_of(), {}, NEEDED),  # by the profile
        *((morph_of((*at, value)), {}, (*NEEDED[:k], new[k], *NEEDED[k + 1 :]))
          for value, new in ((0.041, GROWN), (0.039, BOX)) for k, at in enumerate(EDGES)),
        # three dark rows at either end stay, four do not
        (morph_of((3, 10, 0.011), (26, 10, 0.011), *AROUND), {}, (10, 24, 40, 36)),
        (morph_of((3, 10, 0.009), (4, 10, 0.011), (25, 10, 0.011), (26, 10, 0.009), *AROUND), {},
         (14, 24, 36, 36)),
        (np.zeros((30, 20)), {}, NEEDED),
        (np.ones((50, 60)), {"origin": (0, 0)}, (0, 0, 50, 60)),  # the whole frame
        (np.ones((49, 58)), {"origin": (1, 1)}, (0, 0, 50, 60)),
    ],
)  # fmt: skip
def test_boxes_grow_and_shrink_by_their_edges(morph, given, wanted):
    """By 8 px where an edge has 4 times 0.1 of the noise (0.04); shrunk where 4 px are dark."""
    origin, fixed = given.get("origin", (10, 20)), given.get("fixed", False)
    one = SimpleNamespace(origin=np.array([origin]), fixed=[fixed], unpadded_shape=(50, 60))
    state = SimpleNamespace(morph=[morph], spectra=np.array([[10.0]]))
    start = point_of(_spot((50, 60), (25, 30), 1.0)[None], (25, 30))
    low, high = _box(one, state, 0, start, np.ones(1))
    assert (*low, *high) == wanted


def _spot(shape, at, sigma):
    y, x = np.indices(shape)
    return np.exp(-0.5 * ((y - at[0]) ** 2 + (x - at[1]) ** 2) / sigma**2)


def test_what_is_moved_keeps_its_pixels():
    array, fill = np.arange(6.0).reshape(2, 3), np.full((3, 3), 9.0)
    found = _moved(array, np.array([4, 5]), np.array([3, 6]), np.array([6, 9]), fill)
    assert found.tolist() == [[9, 9, 9], [1, 2, 9], [4, 5, 9]]
    found = _moved(array, np.array([4, 5]), np.array([3, 6]), np.array([6, 9]), None)
    assert found.tolist() == [[0, 0, 0], [1, 2, 0], [4, 5, 0]]
    one = SimpleNamespace(profile=[array], origin=np.array([[4, 5]]))
    assert _same(one, 0, (np.array([4, 5]), np.array([6, 8])))
    assert not _same(one, 0, (np.array([4, 6]), np.array([6, 9])))
    assert not _same(one, 0, (np.array([4, 5]), np.array([6, 9])))


TWO = [0, 0], [[0, 0]] * 2, [[3, 4]] * 2


@pytest.mark.parametrize(
    "given, words",
    [
        *(((*TWO, [[2, 3], center]), r"center is .* for source 1, outside its box .*\(3, 4\)")
          for center in ((-1, 0), (0, -1), (3, 0), (0, 4))),
        (([0], [[0, 0, 0]], [[3, 3]]), r"origin has shape \(1, 3\), must be \(S, 2\)"),
        (([[0]], [[0, 0]], [[3, 3]]), r"scene has shape \(1, 1\), must be \(S,\)"),
        (([0], [[0, 0]], [[0, 3]]), r"shape is \[0, 3\] for source 0"),
        ((*TWO, [[1, 1]]), "center has 1 boxes, scene has 2"),
    ],
)  # fmt: skip
def test_boxes_that_make_no_sense_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        Boxes(*given)


def test_arrays_of_boxes():
    assert Boxes([0, 0], [[0, 0]] * 2, [[4, 5], [1, 2]]).center.tolist() == [[1, 2], [0, 0]]
    with pytest.raises(ValueError, match="morphs has 1 arrays for 2 boxes"):
        Boxes(*TWO).pack([np.zeros((3, 4))])


@pytest.mark.parametrize("which", [[2], [-1], np.array([True, False, True])])
def test_active_sources_are_those_there_are(device, which):
    boxes = Boxes(*TWO).put(device)
    with pytest.raises(ValueError, match="active"):
        boxes.active(which)
    assert device.get(boxes.active([1])).tolist() == [1]
    assert device.get(boxes.active(np.array([True, False]))).tolist() == [0]
    assert boxes.active(None) is boxes.everyone


def test_variances_are_at_least_those_with_all_else_known():
    """Even if rounding lowers them; of unobserved spectra they are infinite."""
    near = np.array([[1.0, 1 - 1e-17, 0], [1 - 1e-17, 1.0, 0], [0, 0, 0]])
    for unit in (1.0, 1e-6, 1e6):
        found = spectrum_covariance(unit * near[None])[0]
        assert (np.diag(found)[:2] >= 0.99 / unit).all()
        assert np.isinf(found[2, 2]) and not found[2, :2].any()
    plain = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(spectrum_covariance(plain[None])[0], np.linalg.inv(plain), rtol=1e-7)
