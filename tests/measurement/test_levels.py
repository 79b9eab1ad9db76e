"""Smooth levels of signal-to-noise images: of sky left in, of wings; what is no level stays."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from clresample.measurement.detection import detect
from clresample.measurement.levels import CELL_PX, deficit_of, level_of
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

N = 8 * CELL_PX
SEEN = np.ones((N, N), bool)


def noise(seed=0):
    return np.random.default_rng(seed).normal(size=(N, N))


def test_noise_and_faint_sources_have_no_level():
    image = noise()
    image[::20, ::20] += 50
    level, sky = level_of(image, SEEN)
    assert not level.any() and sky == 0


@pytest.mark.parametrize("offset", [4.0, -4.0])
def test_a_constant_is_level_and_sky(offset):
    level, sky = level_of(noise() + offset, SEEN)
    np.testing.assert_allclose(level, offset, atol=0.1)
    assert sky == pytest.approx(offset, abs=0.1)


def test_wings_on_one_side_are_a_level_and_no_sky():
    ramp = np.linspace(0, 40, N)[None, :] * np.ones((N, 1))
    level, sky = level_of(noise() + np.maximum(ramp - 15, 0), SEEN)
    assert sky == 0 and level[N // 2, -40] > 12 and not level[:, : CELL_PX // 2].any()


def test_pixels_that_were_not_seen_do_not_count():
    image, seen = noise() + 3, SEEN.copy()
    seen[:, : N // 2], image[:, : N // 2] = False, -1000
    level, sky = level_of(image, seen)
    assert level.min() > 1.5 and sky > 1.5
    assert not level_of(image, np.zeros_like(seen))[0].any()


def test_sky_left_in_makes_no_sources_and_no_footprints():
    """0.5 sigma of a pixel is 2 to 3 sigma of a filter's signal to noise."""
    rng = np.random.default_rng(3)
    data = rng.normal(size=(N, N)) + 0.5
    data[100:103, 100:103] += 40.0
    o = Observation(data, PSF.gaussian(1.8, n_pixels=25), Grid.flat((N, N), 0.1), weights=1.0)
    found = detect([o], scatters=[[1.0, 1.0, 1.0]])
    assert len(found.sources) == 1
    assert (found.image > 2).mean() < 0.05


def filtered_noise(size, seed=0):
    """Noise of unit scatter that is correlated over 4 pi 2^2 pixels."""
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(size, size)), 2.0)
    return smooth * np.sqrt(4 * np.pi) * 2.0, 4 * np.pi * 4


@pytest.mark.parametrize("size", [40, 300])
def test_a_level_below_zero_is_a_deficit_and_one_above_is_none(size):
    image, area = filtered_noise(size)
    image[::20, ::20] += 50
    seen = np.ones(image.shape, bool)
    for offset in (0.0, 0.5, 3.0):
        assert np.mean(deficit_of(image + offset, seen, area)) == pytest.approx(0, abs=0.05)
    for offset in (-2.0, -5.0):
        found = np.broadcast_to(deficit_of(image + offset, seen, area), image.shape)
        np.testing.assert_allclose(found, offset, atol=0.6)
    assert deficit_of(image - 5, np.zeros_like(seen), area) == 0


def test_a_deficit_follows_a_gradient_where_it_is_below_zero():
    image, area = filtered_noise(5 * CELL_PX)
    ramp = np.linspace(-4, 4, len(image))[None, :] * np.ones((len(image), 1))
    found = deficit_of(image + ramp, np.ones(image.shape, bool), area)
    np.testing.assert_allclose(found[:, 20:120], ramp[:, 20:120], atol=1.2)
    assert not found[:, -CELL_PX:].any()


@pytest.mark.parametrize("sky", [-0.1, -0.3])
def test_a_sky_of_which_too_much_was_subtracted_hides_no_source(sky):
    """-0.3 of a pixel's noise is -2 to -5 in a filter's, which hid all of these sources."""
    rng = np.random.default_rng(5)
    places = [(y, x) for y in range(20, 101, 26) for x in range(20, 101, 26)]
    data, psf = rng.normal(size=(120, 120)), PSF.gaussian(1.8, n_pixels=25)
    peak = 12 / np.sqrt((psf.images[0] ** 2).sum())
    for y, x in places:
        data[y - 12 : y + 13, x - 12 : x + 13] += peak * psf.images[0]
    o = Observation(data + sky, psf, Grid.flat((120, 120), 0.1), weights=1.0)
    found = np.array([source.position_px for source in detect([o]).sources])
    away = np.hypot(*(np.array(places)[:, None] - found).transpose(2, 0, 1)).min(axis=1)
    assert (away < 3).sum() >= len(places) - 1
