"""Smooth levels of signal-to-noise images: of sky left in, of wings; what is no level stays."""

import numpy as np
import pytest

from clresample.measurement.detection import detect
from clresample.measurement.levels import CELL_PX, level_of
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
