"""Boxes by the light they hold, grown and trimmed at their limits; and what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.start import point_of

from clresample.deblending.solver.boxes import Boxes
from clresample.deblending.spectra import spectrum_covariance
from clresample.deblending.start.boxes import box_around, box_threshold, component_box
from clresample.paper.resize import _box, _moved, _same


def test_boxes_hold_a_tenth_of_the_noise():
    """Or what structure of 10 % may be: the square of the brightness; within float32 and 0.5 %."""
    given = [0.0, 5.0, 10.0, 20.0, 1e3, 1e5, 1e9]
    found = [float(box_threshold(b)) for b in given]
    np.testing.assert_allclose(found, [5e-3, 5e-3, 5e-3, 2.5e-3, 1e-6, 1e-7, 1e-7])
    assert box_threshold(15.0) == pytest.approx(1 / 225)


def test_boxes_end_where_light_does():
    """With five pixels about the centre at least; the last pixel that is lit belongs to it."""
    profile = np.zeros((40, 41))
    profile[20, 22], profile[8, 22], profile[20, 39] = 1.0, 0.01, 0.006
    profile[39, 0] = 0.004
    for at in ((20.0, 22.0), (19.5, 22.49)):
        low, size, centre = box_around(profile, at, 1.0)
        assert [*low, *(low + size)] == [8, 17, 26, 40] and [*centre] == [12, 5]
    low, size, centre = box_around(profile, (1.0, 38.0), 1.0)
    assert [*low, *(low + size)] == [0, 22, 21, 41] and [*centre] == [1, 16]
    low, size, centre = box_around(0 * profile, (90.0, -7.0), 1.0)  # nothing, outside
    assert [*low, *(low + size)] == [34, 0, 40, 6] and [*centre] == [5, 0]


def test_boxes_of_a_start_hold_five_pixels_about_small_sources():
    """Where its light ends before; as far as the frame goes."""
    for place, wanted in (((25, 30), [20, 25, 31, 36]), ((3, 57), [0, 52, 9, 60])):
        image = _spot((50, 60), place, 0.4)
        low, size, centre, part = component_box(point_of(image[None], place), 0, (50, 60), 1.0)
        assert [*low, *(low + size)] == wanted and [*(low + centre)] == [*place]
        np.testing.assert_allclose(part, image[low[0] : wanted[2], low[1] : wanted[3]])


def test_boxes_grow_and_shrink_by_their_edges():
    """By 8 px where an edge holds 4 times 0.1 of the noise; shrunk where 4 px or more are dark."""
    noise, start = np.ones(1), point_of(_spot((50, 60), (25, 30), 1.0)[None], (25, 30))

    def box(morph, origin=(10, 20), extent=(50, 60), fixed=False):
        one = SimpleNamespace(origin=np.array([origin]), fixed=[fixed], unpadded_shape=extent)
        state = SimpleNamespace(morph=[morph], spectra=np.array([[10.0]]))
        low, high = _box(one, state, 0, start, noise)
        return [*low, *high]

    morph = np.zeros((30, 20))
    morph[15, 10] = 1.0  # 0.01 is a tenth of the noise, which fades at 0.04
    assert box(morph, fixed=True) == [10, 20, 40, 40]
    assert box(morph) == [20, 25, 31, 36]  # what the profile needs
    for (y, x), wanted in (
        ((0, 10), [2, 25, 31, 36]),
        ((29, 10), [20, 25, 48, 36]),
        ((15, 0), [20, 12, 31, 36]),
        ((15, 19), [20, 25, 31, 48]),
    ):
        bright, fading = morph.copy(), morph.copy()
        bright[y, x], fading[y, x] = 0.041, 0.039
        assert box(bright) == wanted
        kept = [20, 25, 31, 36]
        for k, edge, at in ((0, 10, y == 0), (1, 20, x == 0), (2, 40, y == 29), (3, 40, x == 19)):
            kept[k] = edge if at else kept[k]
        assert box(fading) == kept
    wide = np.zeros((30, 20))
    wide[15, 10] = 1.0
    wide[3, 10], wide[26, 10], wide[15, 4], wide[15, 15] = [0.011] * 4
    assert box(wide) == [10, 24, 40, 36]  # three dark rows at either end stay
    wide[3, 10] = wide[26, 10] = 0.009
    wide[4, 10], wide[25, 10] = 0.011, 0.011
    assert box(wide) == [14, 24, 36, 36]
    assert box(0 * wide) == [20, 25, 31, 36]  # one without any light
    full = np.full((50, 60), 1.0)
    assert box(full, origin=(0, 0)) == [0, 0, 50, 60]
    assert box(np.full((49, 58), 1.0), origin=(1, 1)) == [0, 0, 50, 60]


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


@pytest.mark.parametrize("center", [(-1, 0), (0, -1), (3, 0), (0, 4)])
def test_a_centre_lies_in_its_box(center):
    with pytest.raises(ValueError, match=r"center is .* for source 1, outside its box .*\(3, 4\)"):
        Boxes([0, 0], [[0, 0]] * 2, [[3, 4]] * 2, [[2, 3], center])


@pytest.mark.parametrize("which", [[2], [-1], np.array([True, False, True])])
def test_active_sources_are_those_there_are(device, which):
    boxes = Boxes([0, 0], [[0, 0]] * 2, [[3, 4]] * 2).put(device)
    with pytest.raises(ValueError, match="active"):
        boxes.active(which)
    assert device.get(boxes.active([1])).tolist() == [1]
    assert device.get(boxes.active(np.array([True, False]))).tolist() == [0]
    assert boxes.active(None) is boxes.everyone


def test_boxes_that_make_no_sense_are_refused():
    for given, words in (
        (([0], [[0, 0, 0]], [[3, 3]]), r"origin has shape \(1, 3\), must be \(S, 2\)"),
        (([[0]], [[0, 0]], [[3, 3]]), r"scene has shape \(1, 1\), must be \(S,\)"),
        (([0], [[0, 0]], [[0, 3]]), r"shape is \[0, 3\] for source 0"),
        (([0, 0], [[0, 0]] * 2, [[3, 3]] * 2, [[1, 1]]), "center has 1 boxes, scene has 2"),
    ):
        with pytest.raises(ValueError, match=words):
            Boxes(*given)
    middle = Boxes([0, 0], [[0, 0]] * 2, [[4, 5], [1, 2]]).center
    assert middle.tolist() == [[1, 2], [0, 0]]
    with pytest.raises(ValueError, match="morphs has 1 arrays for 2 boxes"):
        Boxes([0, 0], [[0, 0]] * 2, [[3, 3]] * 2).pack([np.zeros((3, 3))])


def test_variances_are_at_least_those_with_all_else_known():
    """Where rounding says otherwise; of what is not seen they are infinite."""
    near = np.array([[1.0, 1 - 1e-17, 0], [1 - 1e-17, 1.0, 0], [0, 0, 0]])
    for unit in (1.0, 1e-6, 1e6):
        found = spectrum_covariance(unit * near[None])[0]
        assert (np.diag(found)[:2] >= 0.99 / unit).all()
        assert np.isinf(found[2, 2]) and not found[2, :2].any()
    plain = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(spectrum_covariance(plain[None])[0], np.linalg.inv(plain), rtol=1e-7)
