"""Sources listed as galaxies that look like the PSF: fitted as stars."""

import numpy as np
import pytest
from helpers.inspection import FWHM_SIGMA, inspected, sources_of, with_photon_noise

from clresample.deblending.batch import deblend
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

STAR = ((30.3, 29.6), (60_000, 90_000), 0.0)
FAINT = ((12.0, 44.0), (1500, 2500), 1.5)


def kinds(drawn, listed=ExtendedSource, *, psf_sigma=FWHM_SIGMA, **settings):
    o = with_photon_noise(drawn, psf_sigma=psf_sigma)
    found = inspected([o], sources_of(drawn, listed), **settings)
    return [type(source) for source in found.blend.sources]


def test_a_bright_point_is_a_star():
    assert kinds((STAR, FAINT)) == [PointSource, ExtendedSource]


@pytest.mark.parametrize("sigma", [0.7, 1.5, 4.0])
def test_a_galaxy_is_none(sigma):
    assert kinds(((*STAR[:2], sigma), FAINT)) == [ExtendedSource] * 2


@pytest.mark.parametrize(("light", "kind"), [(1, ExtendedSource), (0, PointSource)])
def test_a_galaxy_hardly_wider_than_the_psf_is_none(light, kind):
    """By 4 %, as clearly as noise of this signal to noise allows."""
    assert kinds(((STAR[0], (16_000, 25_000), 0.45 * light),)) == [kind]


@pytest.mark.parametrize(("wrong", "kind"), [(1.02, PointSource), (1.15, ExtendedSource)])
def test_the_psf_may_be_as_wrong_as_stated(wrong, kind):
    assert kinds((STAR,), psf_sigma=wrong * FWHM_SIGMA) == [kind]


def test_a_psf_without_errors_is_that_of_stars_alone():
    assert kinds((STAR,), psf_sigma=1.02 * FWHM_SIGMA, psf_error=0.0) == [ExtendedSource]


def test_a_point_in_a_host_and_faint_points_stay_galaxies():
    host = (STAR[0], (9000, 12_000), 4.0)
    assert kinds((STAR, FAINT, host))[:2] == [ExtendedSource] * 2
    assert kinds(((STAR[0], (300, 500), 0.0),)) == [ExtendedSource]


def test_a_nucleus_in_a_wide_faint_host_is_none():
    """The host has a thousandth of its light there."""
    host = (STAR[0], (4000, 6000), 9.0)
    for drawn, kind in (((STAR,), PointSource), ((STAR, host), ExtendedSource)):
        found = inspected([with_photon_noise(drawn)], sources_of((STAR,)))
        assert [type(source) for source in found.blend.sources] == [kind]


def test_a_number_of_components_that_is_given_stays():
    o = with_photon_noise((STAR,))
    one = (ExtendedSource(position_px=STAR[0], n_components=1),)
    assert inspected([o], one).blend.sources == one


def test_a_sharp_star_listed_as_a_galaxy_is_fitted(device):
    """Under a PSF of 1.6 px FWHM no galaxy is as sharp: it would be a misfit."""
    sharp = 0.68
    y, x = np.indices((48, 48))
    s2 = sharp**2 + 1 / 12
    light = 1e5 * np.exp(-((y - 23.4) ** 2 + (x - 24.3) ** 2) / (2 * s2)) / (2 * np.pi * s2)
    variance = 4.0 + light[None] / 5
    data = light + np.random.default_rng(3).normal(size=light.shape) * np.sqrt(variance)
    psf = PSF.gaussian(sharp, n_pixels=49, spacing=0.25)
    o = Observation(data, psf, Grid.flat(light.shape, 0.1), weights=1 / variance)
    source = ExtendedSource(position_px=(23, 24))
    result = deblend([o], [source], device=device)
    assert isinstance(result.sources[0], PointSource) and result.converged
    flux = sum(c.spectrum[0] * c.morphology.sum() for c in result.components)
    assert flux == pytest.approx(1e5, rel=0.01)
