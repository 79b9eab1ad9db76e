"""Morphologies that start from a profile of the user's own."""

import numpy as np
import pytest

from clresample.deblending.batch import deblend
from clresample.deblending.settings import Settings
from clresample.files.results import read_result, write_result
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE = (30, 34)


def scene(profile, sigma=0.01):
    """One band on the model's own pixels, of a source that looks like `profile` and has flux 50."""
    grid, rng = Grid.flat(SHAPE, 0.1), np.random.default_rng(0)
    psf = PSF.gaussian(0.8, n_pixels=21)
    data = 50 * profile / profile.sum() + sigma * rng.standard_normal(SHAPE)
    return Observation(data, psf, grid, weights=sigma**-2, channels=("r",), name="one")


def ring():
    y, x = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2
    return np.exp(-0.5 * ((np.hypot(y, x) - 7) / 2.5) ** 2)


def test_start_is_the_given_profile(tmp_path):
    profile = ring()
    source = ExtendedSource(position_px=(15.0, 17.0), profile=profile)
    result = deblend([scene(profile)], [source], settings=Settings(max_iter=0))
    (y, x), (component,) = result.components[0].origin, result.components
    part = profile[y : y + component.morphology.shape[0], x : x + component.morphology.shape[1]]
    assert np.allclose(component.morphology, part / part.max(), atol=1e-6)
    assert component.flux[0] == pytest.approx(50, rel=0.01)
    write_result(tmp_path / "x.fits", result)
    assert read_result(tmp_path / "x.fits").sources == (source,)


def test_profiles_that_cannot_be_taken():
    for wrong, words in (
        (np.ones(4), "must be"), (np.full(SHAPE, -1.0), "not negative"), (np.zeros(SHAPE), "zero"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            ExtendedSource(position_px=(1, 1), profile=wrong)
    with pytest.raises(ValueError, match="one component"):
        ExtendedSource(position_px=(1, 1), profile=np.ones(SHAPE), n_components=2)
    small = ExtendedSource(position_px=(15, 17), profile=np.ones((20, 20)))
    with pytest.raises(ValueError, match=r"source 0 has the shape \(20, 20\)"):
        deblend([scene(ring())], [small])
