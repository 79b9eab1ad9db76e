"""Chi2 of boxes, labels and the summary of a blend."""

import json

import numpy as np
import pytest
from helpers.blends import (
    MIDDLE,
    SCALE,
    blend,
    observe,
    round_component,
)

from clresample.measurement.catalogue import catalogue
from clresample.measurement.quality import observation_labels, summary
from clresample.sky.grid import Grid


def test_chi2_in_the_box_counts_weighted_pixels_of_the_box_only():
    grid = Grid.flat((60, 70), SCALE)
    data = np.full((2, 60, 70), 7.0)  # far off outside of the box
    box = (slice(20, 41), slice(25, 46))
    data[:, *box] = np.array([2.0, 3.0])[:, None, None]
    weights = np.full((2, 60, 70), 0.5)
    weights[1, 20:41, 25:30] = 0
    observation = observe(grid, ("g", "r"), data=data, weights=weights, name="cam")
    result = blend([round_component(0, MIDDLE, (0, 0))], observations=(observation,))
    expected = 0.5 * (21 * 21 * 4 + 21 * 16 * 9) / (21 * 21 + 21 * 16)
    np.testing.assert_allclose(catalogue(result)["chi2_cam"], expected, rtol=1e-13)


@pytest.mark.parametrize("angle_deg, shift", [(0, (0, 0)), (30, (0, 0)), (30, (3.0, -2.0))])
def test_boxes_are_projected_by_the_mapping_and_the_shift(angle_deg, shift):
    """Data of 1 where the pixel's true place is in the box, huge elsewhere."""
    grid = Grid.flat((60, 70), SCALE)
    coarse = Grid.flat((20, 22), 0.3, angle_deg=angle_deg, flip=True)
    y, x = np.array([29.5, 34.5])[:, None, None] + coarse.sky(*np.indices(coarse.shape)) / SCALE
    y, x = y + shift[0], x + shift[1]
    inside = (y >= 19.5) & (y < 40.5) & (x >= 24.5) & (x < 45.5)
    observation = observe(coarse, ("g",), data=np.where(inside, 1.0, 1e3), weights=2.0)
    component = round_component(0, MIDDLE, (0,))
    result = blend([component], grid=grid, observations=(observation,), shifts=np.array([shift]))
    np.testing.assert_allclose(catalogue(result)["chi2_observation0"], 2.0, rtol=1e-13)


def test_pixels_without_a_model_do_not_count_in_a_box():
    """Two rings of pixels off the frame; a shift puts some on it, but they have no model."""
    data = np.full((1, 64, 74), 1e3)
    data[:, 2:-2, 2:-2] = 2.0
    observation = observe(Grid.flat((64, 74), SCALE), ("g",), data=data)
    component = round_component(0, (10, 35), (0,))
    result = blend([component], observations=[observation], shifts=np.array([[2.0, 0]]))
    np.testing.assert_allclose(catalogue(result)["chi2_observation0"], 4.0, rtol=1e-13)


def test_labels_are_unique():
    grid = Grid.flat((60, 70), SCALE)
    observations = [
        observe(grid, (c,), name=name) for c, name in zip("abcd", ("hst", None, "hst", "hsc"))
    ]
    result = blend([round_component(0, MIDDLE, np.ones(4))], observations=observations)
    assert observation_labels(result) == ["hst0", "observation1", "hst2", "hsc"]


def test_summary_holds_the_blends_figures_as_json():
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[0, :30], weights[1] = 0, 0
    wide = observe(Grid.flat((62, 72), SCALE), ("i",), data=2.0, weights=3.0, name="wide")
    observations = [observe(grid, ("g", "r"), data=1.5, weights=weights, name="cam"), wide]
    result = blend(
        [round_component(0, MIDDLE, (0, 0, 0))],
        observations=observations,
        sky=np.array([1.0, 0, 0]),
        shifts=np.array([[0, 0], [0.25, -1.5]]),
        seconds={"fit": np.float32(0.5)},
        messages=("one",),
    )
    found = summary(result)
    assert found["n_pixels"] == {"g": 30 * 70, "r": 0, "i": 60 * 70}  # not off the frame
    np.testing.assert_allclose([found["chi2"]["g"], found["chi2"]["i"]], [0.25, 12], rtol=1e-13)
    assert np.isnan(found["chi2"]["r"])
    assert found["shifts"] == {"cam": [0, 0], "wide": [0.25, -1.5]}
    assert found["losses"] == [100, 10, 9] and found["n_iterations"] == 2
    assert (found["n_sources"], found["n_fitted"], found["n_components"]) == (1, 1, 1)
    assert json.loads(json.dumps(found))["seconds"] == {"fit": 0.5}
