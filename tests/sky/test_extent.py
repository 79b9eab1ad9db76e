"""Parts of a grid that others touch: overlaps without a whole mapping, and boxes of pixels."""

import numpy as np
import pytest
from helpers.headers import DEC, OBSERVED, RA, SCALE, SIP, grid_of, header, observed_headers

from clresample.sky import grid as grid_module
from clresample.sky.box import box_slices, boxes_meet, intersect_boxes
from clresample.sky.extent import grids_overlap
from clresample.sky.grid import Grid
from clresample.sky.wcs import pixel_to_world


def flat_pairs():
    """Names and pairs of flat grids (observed, model)."""
    model = Grid.flat((10, 12), 1.0)
    yield "inside", Grid.flat((4, 4), 1.0), model
    yield "around", Grid.flat((50, 50), 1.0, angle_deg=30), model
    yield "apart", Grid.flat((10, 10), 1.0, center_arcsec=(0, 40)), model
    # centres at 5.5 and 5.6 from the middle of the model, whose edge is at 5
    yield "edge to edge", Grid.flat((1, 1), 1.0, center_arcsec=(5.5, 0)), model
    yield "centre on the edge", Grid.flat((2, 2), 1.0, center_arcsec=(5.5, 0)), model
    yield "a corner", Grid.flat((9, 9), 1.0, center_arcsec=(8.9, 9.9)), model
    yield "just no corner", Grid.flat((9, 9), 1.0, center_arcsec=(9.1, 10.1)), model
    turned = Grid.flat((40, 40), 0.1, angle_deg=45)
    yield "boxes only", Grid.flat((8, 8), 0.09, center_arcsec=(2.5, 2.5)), turned
    yield (
        "one pixel of many",
        Grid.flat((2000, 2000), 0.1, center_arcsec=(0, 0)),
        Grid.flat((1, 1), 0.1, center_arcsec=(31.25, -17.65)),
    )
    yield "between the pixels", Grid.flat((30, 30), 1.0), Grid.flat((1, 1), 0.01)


@pytest.mark.parametrize(
    ("observed", "model"), [pytest.param(*pair, id=name) for name, *pair in flat_pairs()]
)
def test_overlap_is_that_of_the_mapping(observed, model):
    assert grids_overlap(observed, model) == observed.map_to(model).covered.any()


def test_the_cases_are_of_both_kinds():
    answers = [grids_overlap(observed, model) for _, observed, model in flat_pairs()]
    assert sum(answers) >= 4 and len(answers) - sum(answers) >= 4


@pytest.mark.parametrize(
    "cards", [pytest.param(cards, id=name) for name, cards in observed_headers()]
)
def test_overlap_on_the_sky(cards):
    observed = grid_of(cards, OBSERVED)
    lon, lat = observed.sky(3.2, 40.7)
    near = grid_of(header((3, 3), ra=lon, dec=lat, scale=SCALE / 3), (3, 3))
    assert grids_overlap(observed, near) == observed.map_to(near).covered.any()
    corner = grid_of(header((9, 9), ra=lon, dec=lat, scale=SCALE), (9, 9))
    assert grids_overlap(observed, corner) and grids_overlap(corner, observed)
    for dec in (DEC + 0.1, DEC + 40):
        assert not grids_overlap(observed, grid_of(header((20, 20), dec=dec), (20, 20)))
    other_side = grid_of(header((20, 20), ra=RA + 180, dec=-DEC), (20, 20))
    assert not grids_overlap(observed, other_side) and not grids_overlap(other_side, observed)


def test_a_distorted_image_is_not_evaluated_pixel_by_pixel(monkeypatch):
    shape = (2000, 2500)
    small = {key: value * 1e-3 if key[2].isdigit() else value for key, value in SIP.items()}
    observed = grid_of(header(shape, ctype="TAN-SIP", **small), shape)
    frame = grid_of(header((2100, 2600), scale=SCALE), (2100, 2600))
    evaluated = []
    monkeypatch.setattr(
        grid_module,
        "pixel_to_world",
        lambda wcs, n, m: evaluated.append(np.size(n)) or pixel_to_world(wcs, n, m),
    )
    assert grids_overlap(observed, frame)
    assert sum(evaluated) < 5000  # of 5 million pixels


def test_shared_part_of_two_boxes():
    a, b = np.arange(30).reshape(5, 6), np.arange(100, 120).reshape(4, 5)
    for origin in ((0, 0), (2, 3), (-2, -1), (-3, 4), (4, 5), (1, -4)):
        here, there = intersect_boxes((10, 20), a.shape, np.add((10, 20), origin), b.shape)
        expected = np.zeros((20, 20))
        expected[5:10, 5:11] = 1
        y, x = np.add((5, 5), origin)
        expected[y : y + 4, x : x + 5] += 1
        assert a[here].shape == b[there].shape and a[here].size == (expected == 2).sum() > 0
        # the same pixel of the sky on both sides
        at = [np.argwhere(m == m[part][0, 0])[0] for m, part in ((a, here), (b, there))]
        np.testing.assert_array_equal(at[0], np.add(at[1], origin))
    for origin in ((5, 0), (0, 6), (-4, 0), (0, -5), (90, -90)):
        here, there = intersect_boxes((0, 0), a.shape, origin, b.shape)
        assert a[here].size == b[there].size == 0
        assert a[here].shape == b[there].shape
        # at an edge of the first array, not beyond it
        assert all(0 <= s.start <= s.stop <= n for s, n in zip(here, a.shape, strict=True))
    assert box_slices(np.array([1, 2]), (3, 4)) == (slice(1, 4), slice(2, 6))


def test_boxes_meet_if_they_share_a_pixel():
    low = np.array([[0, 0], [3, 3], [4, 0], [0, 4], [1, 1]])
    high = low + [[4, 4], [1, 1], [2, 2], [2, 2], [1, 1]]
    found = boxes_meet(low, high, low[0], high[0])
    assert found.tolist() == [True, True, False, False, True]
    pairs = boxes_meet(low[:, None], high[:, None], low, high)
    assert pairs.tolist() == pairs.T.tolist() and pairs[0].tolist() == found.tolist()
