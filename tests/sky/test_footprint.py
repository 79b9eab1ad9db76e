"""Positions of observed pixels in the model frame, and the observed part of it."""

import numpy as np
from helpers.blends import (
    observe,
    one_source,
)
from helpers.headers import SIP, grid_of, header

from clresample.sky.footprint import coverage_border


def test_locate_inverts_the_mapping_of_a_distorted_image():
    grid = grid_of(header((60, 70)), (60, 70))
    strong = {key: 20 * value if "_ORDER" not in key else value for key, value in SIP.items()}
    cards = header((40, 44), scale=0.3 / 3600, ctype="TAN-SIP", CROTA2=20, **strong)
    seen = grid_of(cards, (40, 44))
    shifts = np.array([[0.4, -1.3]])
    result = one_source(grid=grid, observations=[observe(seen, ("g", "r"))], shifts=shifts)
    (footprint,) = result.footprints
    assert footprint.mapping.geometry == "distorted"
    truth = np.array([[20.0, 22.0], [8.3, 30.6], [25.2, 11.9]])
    points = grid.pixel(*seen.sky(*truth.T)) + [0.4, -1.3]
    np.testing.assert_allclose(footprint.locate(points), truth, atol=0.01)
    assert footprint.weighted(points).shape == (2, 3)
    np.testing.assert_array_equal(
        footprint.contains([[30, 35], [np.nan, 0], [500, 500]]), [1, 0, 0]
    )


def test_the_open_edge_of_a_frame_that_is_all_seen_is_its_border():
    expected = np.ones((60, 70), bool)
    expected[1:-1, 1:-1] = False
    np.testing.assert_array_equal(coverage_border(one_source().unobserved), expected)
