"""The background's level and scatter, and what they make of sources, gaps and correlated noise."""

import warnings

import numpy as np
import pytest

from clresample.sky.filled import filled_pixels
from clresample.sky.noise import background, noise_sigma, sigma_below_zero

# relative error of a MAD from n pixels of Gaussian noise, 1.17 / sqrt(2 n), at 5 sigma
TOLERANCE = 5 * 1.17 / np.sqrt(2)


def noise(shape, sigma=1.0, seed=0):
    return np.random.default_rng(seed).normal(scale=sigma, size=shape)


def test_noise_sigma_is_unbiased_for_white_noise():
    # enough pixels to see the 0.4 % that cutting at 3 sigma takes from the MAD
    image = noise((1600, 1600), 3.0)
    assert noise_sigma(image) == pytest.approx(3.0, rel=TOLERANCE / 1600)


@pytest.mark.parametrize(("share", "bias"), [(0.03, 0.02), (0.1, 0.03), (0.5, 0.3)])
def test_noise_sigma_hardly_sees_sources(share, bias):
    image = noise((300, 300)).ravel()
    n = int(share * image.size)
    image[:n] += np.random.default_rng(1).exponential(10.0, n)
    image[:20] = 1e9
    image[20:25] = np.nan
    sigma = noise_sigma(image.reshape(300, 300))
    assert 1 - 0.01 < sigma < 1 + bias
    assert noise_sigma(-7 * image.reshape(300, 300) + 3) == pytest.approx(7 * sigma)


def test_noise_that_cannot_be_estimated():
    with pytest.raises(ValueError, match="31 pixels are left.*32 are needed"):
        noise_sigma(noise((1, 31)))
    whole = np.rint(noise((40, 40), 0.3))
    n = np.count_nonzero(whole == 0)
    with pytest.raises(ValueError, match=f"{n} of 1600 pixels have the same value, 0, and few"):
        noise_sigma(whole)


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3, 0.45, 0.6])
@pytest.mark.parametrize("value", [0.0, -99.0, 0.7])
def test_pixels_filled_with_a_value_are_no_noise(share, value):
    image = noise((200, 200), 3.0).astype(np.float32)
    image[: int(200 * share)] = value
    image[60::10, 100] = value  # single ones
    level, sigma = background(image)
    assert sigma == pytest.approx(3, rel=TOLERANCE / 126) and abs(level) < 0.15
    assert noise_sigma(image) == sigma


def test_background_is_level_and_scatter():
    image = 7.0 + noise((400, 400), 0.5)
    image[:40] += 100  # a tenth is light
    image[40, :20] = np.nan
    level, sigma = background(image)
    assert level == pytest.approx(7, abs=0.02) and sigma == pytest.approx(0.5, rel=0.03)
    assert sigma == noise_sigma(image)
    masked = background(image, np.arange(400)[:, None] * np.ones(400) < 40)
    # without the light, the error of a median and of a MAD from 144 000 pixels
    np.testing.assert_allclose(masked, (7, 0.5), atol=0.5 * TOLERANCE / 380)


def test_background_of_what_has_none():
    assert background(np.full((5, 5), 3.0)) == (3.0, 0.0)
    assert background(np.array([[1.0, np.nan], [np.inf, 1.0]])) == (1.0, 0.0)
    image = np.zeros((40, 40))
    image[:10] = 5
    assert background(image) == (0.0, 0.0)


def test_the_scatter_below_zero_knows_nothing_of_sources():
    image = noise((300, 300), 2.0)
    assert sigma_below_zero(image) == pytest.approx(2, rel=TOLERANCE * np.sqrt(2) / 300)
    bright = image.copy()
    # two thirds are source, of all brightnesses
    bright[:200] = np.abs(bright[:200]) + np.random.default_rng(1).exponential(50, (200, 300))
    assert sigma_below_zero(bright) == pytest.approx(2, rel=0.03)
    assert noise_sigma(bright) > 1.2 * sigma_below_zero(bright)  # which is why it is there
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sigma_below_zero(np.abs(image)) is None
        assert sigma_below_zero(-np.abs(image[:1, :31])) is None
    assert sigma_below_zero(-np.abs(image[:1, :32])) > 0


@pytest.mark.parametrize("step", [1.0, 0.37])
@pytest.mark.parametrize("sigma", [0.8, 1.3, 2.0, 3.4, 7.7])
def test_noise_of_images_in_steps(sigma, step):
    """Of whole numbers the MAD is one too: 2 or 3 where sigma is 3.4, which is 2.97 or 4.46."""
    whole = np.rint(np.random.default_rng(4).normal(50.3, sigma, (100, 100)))
    level, found = background(step * whole - 7)
    assert found == pytest.approx(step * np.hypot(sigma, 12**-0.5), rel=0.03)
    assert level == pytest.approx(step * 50.3 - 7, abs=0.06 * step * sigma)


def test_values_that_are_few_are_no_steps():
    assert background(np.zeros((20, 20))) == (0.0, 0.0)
    rng = np.random.default_rng(1)
    filled = rng.normal(0, 1, 400)
    filled[::5] = 0.0  # among floats, apart from each other
    apart = filled + 1e-9 * rng.normal(0, 1, 400)
    assert background(filled)[1] == pytest.approx(background(apart)[1], rel=1e-6)


def galaxy(shape):
    y, x = np.indices(shape) - np.array(shape)[:, None, None] / 2
    return 1e3 * np.exp(-np.hypot(y, x) / 8)


@pytest.mark.parametrize("fwhm", [0, 1.5, 4])
def test_filled_pixels_of_white_and_smoothed_noise(fwhm):
    """Half of the frame, a dead column, a square and a single pixel of the same value."""
    from scipy.ndimage import gaussian_filter

    image = gaussian_filter(noise((120, 100), seed=2), fwhm / 2.3548)
    image += galaxy(image.shape) / 50
    filled = np.zeros(image.shape, bool)
    filled[:60, :40] = filled[:, 70] = filled[100:103, 20:23] = filled[90, 90] = True
    image[filled] = 0
    usable = np.ones(image.shape, bool)
    usable[:, 45] = False
    image[:, 45] = 7  # masked: not searched
    np.testing.assert_array_equal(filled_pixels(image, usable), filled)
    np.testing.assert_array_equal(filled_pixels(image[60:80, 50:70], usable[:20, 50:70]), False)


@pytest.mark.parametrize(
    "make",
    [
        lambda light: np.random.default_rng(1).poisson(0.1 + light),
        lambda light: 0.37 * np.random.default_rng(1).poisson(5.0 + light) - 1.8,
        lambda light: np.rint(4 * (noise(light.shape) + light)) / 4,  # compressed in steps
        lambda light: np.rint(16 * (noise(light.shape) + light)) / 16,
        lambda light: np.maximum(noise(light.shape) + light, 0),  # clipped
        lambda light: np.where(light > 1, light, 0),  # a model in its box
        lambda light: 0 * light,
        lambda light: np.minimum(noise(light.shape) + light, 1e9),
    ],
)
def test_images_with_equal_pixels_that_are_data(make):
    image = make(galaxy((200, 200))).astype(float)
    assert not filled_pixels(image, np.ones(image.shape, bool)).any()


def test_rounding_errors_of_a_model_are_no_noise():
    image = galaxy((200, 200)) / 1e3 + noise((200, 200), 1e-8)
    image[:, :20] = 0
    usable, weights = np.ones(image.shape, bool), np.full(image.shape, 1e8)
    assert not filled_pixels(np.where(image > 1e-6, 0, image), usable, weights).any()
    image += np.where(image == 0, 0, noise((200, 200), 1e-4))
    np.testing.assert_array_equal(filled_pixels(image, usable, weights), image == 0)
