"""Scenes on mosaics: the same light, noise as stated, errors of fits that hold only where told."""

import functools

import numpy as np
import pytest

pytest.importorskip("galsim")

from clresample import NoiseCorrelation, Resampler
from clresample.simulation.coadds import mosaic_scene, resampled
from clresample.simulation.scenes import MODEL_PSF_SIGMA_PX, simulate_scene
from clresample.sky.psf import PSF

SCENE = simulate_scene(5)


def model(image):
    """All the scene's light (C, Ny, Nx) [counts] on Euclid's pixels, as a perfect model has it."""
    return np.einsum("sc,syx->cyx", image.counts, SCENE.euclid.truth)


@functools.cache
def mosaics(kind):
    """The scene on both instruments' mosaics."""
    return mosaic_scene(SCENE, np.random.default_rng(1), kind=kind)


def residual(image, observation):
    """Observation minus the perfect model, and where it has weight, away from the edge."""
    op = Resampler(
        SCENE.euclid.grid,
        PSF.gaussian(MODEL_PSF_SIGMA_PX),
        observation.grid,
        observation.psf,
        dtype=np.float64,
    )
    inside = np.zeros(observation.shape, bool)
    inside[:, 8:-8, 8:-8] = True
    return observation.data - op(model(image)), inside & (observation.weights > 0)


@pytest.mark.parametrize("kind", ["lanczos", "drizzle"])
@pytest.mark.parametrize("name", ["euclid", "rubin"])
def test_a_mosaic_is_the_scene_with_the_stated_noise(kind, name):
    image = getattr(mosaics(kind), name)
    observation = image.observation()
    away, inside = residual(image, observation)
    assert observation.shape[1] > 1.4 * image.data.shape[1]
    chi2 = observation.chi2_map(away)
    assert np.nanmean(np.where(inside, chi2, np.nan)) == pytest.approx(1, abs=0.06)
    found = NoiseCorrelation.from_realisations(
        np.where(inside, away, 0), weights=np.where(inside, observation.weights, 0)
    )
    stated = observation.noise[0].error_factor(2.0)
    assert found.error_factor(2.0) == pytest.approx(stated, rel=0.12)
    assert stated > 1.5  # what white noise would miss


@pytest.mark.parametrize("kind", ["lanczos", "drizzle"])
def test_an_estimate_from_a_blends_sky_finds_it(kind):
    image = mosaics(kind).euclid
    observation = image.observation()
    found = NoiseCorrelation.estimate(observation.data[0], observation.weights[0])
    stated = observation.noise[0].error_factor(2.0)
    assert found.error_factor(2.0) == pytest.approx(stated, rel=0.1)


def test_resampling_keeps_the_noise_that_was_drawn():
    grid = SCENE.euclid.grid
    one, other = (resampled(SCENE.rubin, grid=grid, noise=n) for n in ("correlated", "white"))
    a, b = one.observation(), other.observation()
    assert np.array_equal(a.data, b.data) and b.noise is None
    assert a.noise[0].error_factor(2.0) > 2
    assert a.data.sum() == pytest.approx(SCENE.rubin.data[:, 3:-3, 3:-3].sum(), rel=0.02)
    with pytest.raises(ValueError, match="make another mosaic"):
        one.with_noise(np.random.default_rng(0))


def test_what_is_no_mosaic_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="kind is 'bicubic'"):
        mosaic_scene(SCENE, rng, kind="bicubic")
    with pytest.raises(ValueError, match="noise is 'pink'"):
        mosaic_scene(SCENE, rng, kind="lanczos", noise="pink")
    placed = simulate_scene(5, n_sources=1, center_deg=(10.0, 2.0))
    with pytest.raises(ValueError, match="celestial WCS"):
        resampled(placed.rubin, grid=placed.euclid.grid)
