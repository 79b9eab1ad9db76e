"""Observations: every way of giving the noise, and what is checked."""

import warnings

import numpy as np
import pytest

from clresample.sky.grid import Grid
from clresample.sky.noise import NoiseWarning
from clresample.sky.observation import Observation, check_observations
from clresample.sky.psf import PSF

SHAPE = (3, 20, 24)
GRID = Grid.flat(SHAPE[1:], 0.2)
ONE = PSF.gaussian(1.5, n_pixels=17)
# relative error of a MAD from n pixels of Gaussian noise, 1.17 / sqrt(2 n), at 5 sigma
TOLERANCE = 5 * 1.17 / np.sqrt(2)


def noise(shape=SHAPE, sigma=1.0, seed=0):
    return np.random.default_rng(seed).normal(scale=sigma, size=shape)


def observe(data=None, *, psf=ONE, grid=GRID, **options):
    return Observation(noise() if data is None else data, psf, grid, **options)


def test_one_channel_and_many():
    one = observe(noise(SHAPE[1:]), weights=2.0)
    assert one.shape == (1, *SHAPE[1:]) and one.channels == ("channel0",)
    many = observe(noise().astype(">f4"), name="rubin", weights=2.0)
    assert many.channels == ("rubin0", "rubin1", "rubin2")
    assert many.data.dtype == many.weights.dtype == np.float64
    assert many.psf.n_bands == 3 and ONE.n_bands == 1
    np.testing.assert_array_equal(many.psf.images, np.repeat(ONE.images, 3, axis=0))
    three = PSF.gaussian((1.0, 1.5, 2.0), n_pixels=17)
    assert observe(psf=three).psf is three
    assert observe(noise(SHAPE[1:]), channels="F814W", weights=1).channels == ("F814W",)


def test_what_is_given_is_copied_and_kept():
    data, weights = noise(), np.ones(SHAPE)
    observation = observe(data, weights=weights)
    data[:], weights[:] = 7, 7
    assert observation.data.max() < 7 and observation.weights.max() == 1
    with pytest.raises(ValueError, match="read-only"):
        observation.data[0] = 0
    with pytest.raises(AttributeError):
        observation.name = "other"


@pytest.mark.parametrize("shape", [(), (3,), SHAPE[1:], SHAPE])
def test_weights_and_variance_mean_the_same(shape):
    variance = np.random.default_rng(1).uniform(0.5, 2, shape)
    expected = variance.reshape(3, 1, 1) if shape == (3,) else variance
    by_variance, by_weights = observe(variance=variance), observe(weights=1 / variance)
    np.testing.assert_allclose(by_variance.weights, np.broadcast_to(1 / expected, SHAPE))
    np.testing.assert_array_equal(by_variance.weights, by_weights.weights)
    assert by_variance.messages == by_weights.messages == ()


def test_what_has_no_variance_has_no_weight():
    variance = np.full(SHAPE, 4.0)
    variance[0, 0, :5] = np.nan, 0, -1, np.inf, 1e-310
    observation = observe(variance=variance)
    # an infinite variance is one: of a pixel that says nothing
    assert observation.n_invalid == 4 and observation.messages[0].startswith("4 of 1440 pixels")
    assert (observation.weights[0, 0, :5] == 0).all()
    assert np.count_nonzero(observation.weights == 0.25) == observation.weights.size - 5
    weights = np.ones(SHAPE)
    weights[1, 2, 3] = np.nan
    observation = observe(weights=weights)
    assert observation.n_invalid == 1 and observation.weights[1, 2, 3] == 0


@pytest.mark.parametrize("given", [{}, {"weights": 1.0}, {"variance": 1.0}])
def test_bad_pixels_get_no_weight_and_are_counted(given):
    data = noise()
    data[0, 0, 0], data[1, 2, 3], data[2, 5, 5] = np.nan, np.inf, -np.inf
    mask = np.zeros(SHAPE[1:], bool)
    mask[5, 5] = mask[6, 6] = True
    observation = observe(data, mask=mask, **given)
    # the third lies under the mask: ignored anyway
    assert observation.n_invalid == 2 and observation.messages[-1].startswith("2 of 1440")
    lost = (observation.weights[0, 0, 0], observation.weights[1, 2, 3])
    assert lost == (0, 0) and (observation.data[[0, 1, 2], [0, 2, 5], [0, 3, 5]] == 0).all()
    assert (observation.weights[:, mask] == 0).all()
    assert np.count_nonzero(observation.weights) == data.size - 2 - 6
    assert np.isfinite(observation.data).all() and np.isfinite(observation.weights).all()


@pytest.mark.parametrize("given", [{}, {"weights": 1.0}, {"variance": 1.0}])
def test_a_channel_without_a_pixel_is_reported(given):
    data = noise()
    data[1] = np.nan
    observation = observe(data, channels=("g", "r", "i"), **given)
    assert observation.n_invalid == data[1].size
    assert observation.messages[-1] == "channel r has no pixel with a weight"
    assert observation.weights[[0, 2]].all() and not observation.weights[1].any()


@pytest.mark.parametrize(
    "given",
    [
        {"data": np.full(SHAPE, np.nan), "weights": 1.0},
        {"data": np.full(SHAPE, np.nan)},
        {"variance": 0.0},
        {"variance": np.nan},
        {"weights": np.nan},
    ],
)
def test_an_image_without_any_usable_pixel_is_warned_of(given):
    with pytest.warns(NoiseWarning, match="no pixel of g, r, i has a weight, and nothing can"):
        assert not observe(**given, channels=("g", "r", "i")).weights.any()


@pytest.mark.parametrize("given", [{"mask": np.ones(SHAPE, bool)}, {"weights": 0.0}])
def test_an_image_that_is_masked_on_purpose_is_not(given):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not observe(**{"weights": 1.0} | given).weights.any()


def test_weight_zero_needs_no_data():
    data, weights = noise(), np.ones(SHAPE)
    data[0, :3], weights[0, :3] = np.nan, 0
    observation = observe(data, weights=weights)
    assert observation.n_invalid == 0 and observation.messages == ()
    assert (observation.data[0, :3] == 0).all()


def test_noise_is_estimated_and_said_where_nothing_is_given():
    sigmas = np.array([0.02, 1.0, 300.0])
    data = noise((3, 100, 100)) * sigmas[:, None, None] + 5
    mask = np.zeros((100, 100), int)
    mask[:, :60] = 1
    data[:, :, :60] = 0  # counted, it would leave no scatter at all
    observation = Observation(data, ONE, Grid.flat((100, 100), 0.2), mask=mask)
    estimated = observation.weights[:, 0, -1] ** -0.5
    np.testing.assert_allclose(estimated, sigmas, rtol=TOLERANCE / np.sqrt(4000))
    for i, message in enumerate(observation.messages):
        assert f"channel{i} estimated" in message and f"sigma = {estimated[i]:.4g}" in message


def test_noise_that_cannot_be_estimated_names_its_channel():
    data = noise()
    data[1] = 4
    with pytest.raises(ValueError, match="channel r: .*same value.*give weights or variance"):
        observe(data, channels=("g", "r", "i"))


def test_zero_points_become_microjansky():
    observation = observe(weights=1, zero_points=(23.9, 26.4, 31.4))
    np.testing.assert_allclose(observation.flux_scale, (1, 0.1, 1e-3))
    np.testing.assert_allclose(observe(weights=1, zero_points=8.9).flux_scale, [1e6] * 3)
    assert observe(weights=1).flux_scale is None


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"data": np.ones(5)}, r"data must be .*not \(5,\)"),
        ({"data": np.ones((0, 20, 24))}, r"data must be .*not \(0, 20, 24\)"),
        ({"data": "image"}, "data must be an array"),
        ({"data": np.ones((3, 24, 20))}, r"data .*\(24, 20\).*grid has \(20, 24\)"),
        ({"psf": PSF.gaussian(1.0, n_bands=2)}, "psf has 2 bands.*3 channels"),
        ({"weights": np.ones((20, 20))}, r"weights has the shape \(20, 20\), data \(3, 20, 24\)"),
        ({"variance": np.ones((2, 20, 24))}, r"variance has the shape \(2, 20, 24\)"),
        ({"mask": np.zeros((20, 20))}, r"mask has the shape \(20, 20\), data"),
        ({"mask": np.full((20, 24), 32)}, "mask must be .*not 32.*bits"),
        ({"mask": np.full((20, 24), np.nan)}, "mask must be .*not nan"),
        ({"weights": np.eye(20, 24) - 0.5}, r"weights has 1380 negative.*\(0, 0, 1\)"),
        ({"weights": (1, np.inf, 1)}, r"weights has 480 infinite.*\(1, 0, 0\)"),
        ({"weights": 1, "variance": 1}, "weights and variance are both given"),
        ({"channels": ("g", "r")}, "channels has 2 names.*3 channels"),
        ({"channels": "gri"}, "channels has 1 names.*3 channels"),
        ({"channels": ("g", "r", "g")}, "channels must be unique.*'g', 'r', 'g'"),
        ({"channels": ("g", "r", 3)}, "channels must be names.*3"),
        ({"zero_points": (27, 27)}, r"zero_points .*3.*not \[27. 27.\]"),
        ({"zero_points": np.nan}, "zero_points .*finite.*nan"),
    ],
)
def test_what_is_no_observation(options, match):
    with pytest.raises(ValueError, match=match) as raised:
        observe(**options)
    assert "\n" not in str(raised.value)


def test_what_cannot_be_fitted_together():
    first = observe(weights=1, channels=("g", "r", "i"), name="A", zero_points=27)
    second = observe(weights=1, channels=("u", "z", "y"), name="B", zero_points=30)
    check_observations([first, second])
    check_observations([first])
    with pytest.raises(ValueError, match="at least one"):
        check_observations([])
    same = observe(weights=1, channels=("u", "r", "y"), name="B", zero_points=30)
    with pytest.raises(ValueError, match="'r' is given twice.*'A' and 'B'"):
        check_observations([first, same])
    without = observe(weights=1, channels=("u", "z", "y"))
    with pytest.raises(ValueError, match="'A' has zero_points, 'with channels u, z, y' has none"):
        check_observations([first, without])
    with pytest.raises(ValueError, match="'A' has zero_points"):
        check_observations([without, first])
    placed = observe(weights=1, channels=("u", "z", "y"), grid=_on_the_sky(GRID), zero_points=30)
    with pytest.raises(ValueError, match="'with channels u, z, y' has a WCS, 'A' has none"):
        check_observations([first, placed])


def _on_the_sky(grid):
    return Grid.from_wcs(grid.to_wcs(), grid.shape)


def test_an_observation_is_restored_with_what_was_found_then():
    data = noise()
    data[0, 0, 0] = np.nan
    first = observe(data, channels=("g", "r", "i"), zero_points=27, name="A")
    assert first.n_invalid == 1 and len(first.messages) == 4  # three estimates, one bad pixel
    kept = {key: getattr(first, key) for key in ("channels", "zero_points", "name")}
    found = {"n_invalid": first.n_invalid, "messages": list(first.messages)}
    again = Observation.restore(first.data, first.psf, GRID, weights=first.weights, **found, **kept)
    for name in ("data", "weights", "zero_points"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert again.psf is first.psf and again.messages == first.messages and again.n_invalid == 1
    assert (again.channels, again.name) == (first.channels, "A")
    with pytest.raises(ValueError, match="channels has 2 names"):
        Observation.restore(
            first.data, first.psf, GRID, weights=1, **found, **kept | {"channels": ("g", "r")}
        )
