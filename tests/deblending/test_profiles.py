"""Smooth profiles and stars: their integrals, their places, and their slopes."""

from math import erf

import galsim
import numpy as np
import pytest
from astropy.modeling.models import Sersic1D

from clresample.deblending.profiles import (
    GalaxyGaussians,
    covariance,
    draw_psf,
    galaxy_reach,
    profile,
    psf_second_moment,
)
from clresample.deblending.sersic import BETA_0, HALF_LIGHT
from clresample.sky.psf import PSF

SHAPE = (41, 46)
STAR = PSF.gaussian(0.8, n_pixels=19)
PARAMETERS = [(0.5, 0.2, -0.3, 1.5), (1.2, -1.0, 0.4, 0.0), (-3.0, 0.0, 0.0, 3.0)]
PLACES = [(20.0, 22.0), (17.3, 24.8), (-0.4, 45.3)]


def central(function, at, step=1e-5):
    """Derivatives of an array by each parameter, by central differences."""
    unit = step * np.eye(len(at))
    return np.array([(function(at + u) - function(at - u)) / (2 * step) for u in unit])


@pytest.mark.parametrize("position", PLACES)
@pytest.mark.parametrize("parameters", PARAMETERS)
def test_slopes_of_a_galaxy(parameters, position):
    at, c_psf = np.array(parameters), psf_second_moment(STAR)
    values = profile(at, position, SHAPE, c_psf)
    slopes = central(lambda p: profile(p, position, SHAPE, c_psf)[0], at)
    np.testing.assert_allclose(values[1:], slopes, rtol=0, atol=1e-8 * values[0].max() + 1e-12)
    found, by = covariance(at, c_psf)
    np.testing.assert_allclose(by, central(lambda p: covariance(p, c_psf)[0], at)[:3], atol=1e-8)
    assert np.linalg.det(found) > 0


@pytest.mark.parametrize("position", PLACES)
@pytest.mark.parametrize("psf", [STAR, PSF.gaussian(1.3, n_pixels=30)], ids=["odd", "even"])
def test_slopes_of_a_star(psf, position):
    values = draw_psf(psf, position, SHAPE)
    slopes = central(lambda p: draw_psf(psf, p, SHAPE)[0], np.array(position))
    np.testing.assert_allclose(values[1:], slopes, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(draw_psf(psf, position, SHAPE, slopes=False), values[:1])


def test_a_star_is_the_psf():
    image = draw_psf(STAR, (20, 22), SHAPE)[0]
    np.testing.assert_allclose(image[11:30, 13:32], STAR.images[0], atol=1e-12)
    assert image.sum() == pytest.approx(1, rel=1e-12)
    image = draw_psf(STAR, (20.5, 22.25), SHAPE)[0]
    y, x = np.indices(SHAPE)
    assert image.sum() == pytest.approx(1, abs=1e-5)
    assert ((y * image).sum(), (x * image).sum()) == pytest.approx((20.5, 22.25), abs=1e-3)
    corner = draw_psf(STAR, (0, 0), SHAPE)[0]
    assert corner.sum() == pytest.approx(STAR.images[0][9:, 9:].sum(), rel=1e-9)
    assert np.abs(corner[20:, 20:]).max() < 1e-12


@pytest.mark.parametrize("moment", [-2.0, 0.0, 0.25])
def test_a_star_has_all_its_light_whatever_noise_does_to_the_moment_of_its_psf(moment):
    """Of a measured PSF, whose wings may be negative."""
    image, (y, x) = STAR.images[0].copy(), np.indices(STAR.images[0].shape) - 9
    wings = np.maximum(y**2, x**2) == 81
    image[wings] += (moment - 0.64) / (y**2 * wings).sum()
    psf = PSF(image / image.sum())
    assert 0.25 - 1e-9 < psf_second_moment(psf)[0, 0] < 0.5
    galaxy = profile(np.array([0.5, 0.1, 0.1, 1.0]), (20, 22), SHAPE, psf_second_moment(psf))
    assert np.isfinite(galaxy).all() and galaxy[0].min() > 0
    assert draw_psf(psf, (20.4, 22.3), SHAPE)[0].sum() == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("center", [(20.0, 22.2), (20.5, 22.3)])
def test_a_star_between_pixels_has_no_lines_along_the_axes(center):
    """It is the Gaussian of the PSF on pixels, which has no light at 12 px."""
    root = 0.8 * np.sqrt(2)
    sides = [
        [0.5 * (erf((i - c + 0.5) / root) - erf((i - c - 0.5) / root)) for i in range(n)]
        for n, c in zip(SHAPE, center, strict=True)
    ]
    drawn, wanted = draw_psf(PSF.gaussian(0.8), center, SHAPE)[0], np.outer(*sides)
    assert np.abs(drawn - wanted).max() < 1e-3 * wanted.max()
    y, x = np.indices(SHAPE)
    far = np.hypot(y - center[0], x - center[1]) > 12
    assert np.abs(drawn[far]).max() < 3e-6 * drawn.max()


@pytest.mark.parametrize("sigma", [(9.0, 1.0), (1.0, 9.0)])
def test_a_long_psf_does_not_come_back_on_the_other_side(sigma):
    """Whichever of its sides is the longer one: beyond its last pixel there is nothing."""
    along = [np.exp(-0.5 * (np.arange(-3 * s, 3 * s + 1) / s) ** 2) for s in sigma]
    psf = PSF(np.outer(*along))
    drawn = draw_psf(psf, (0.0, 0.0), (45, 45), slopes=False)[0]
    height, width = (n // 2 + 1 for n in psf.images.shape[1:])
    assert drawn[0, 0] == drawn.max() > 0.01
    assert np.abs(drawn[height:]).max() < 1e-12 and np.abs(drawn[:, width:]).max() < 1e-12


@pytest.mark.parametrize("position", PLACES[:2])
def test_a_galaxy_is_what_its_parameters_say(position):
    """Unit integral; the second moments of a Gaussian where beta is large."""
    at = np.array([np.log(3.0), 0.4, -0.2, np.log(1e4)])
    wide = (121, 131)
    image = profile(at, position + np.array([40, 42]), wide, psf_second_moment(STAR))[0]
    assert image.sum() == pytest.approx(1, rel=1e-6)
    y, x = np.indices(wide) - (np.array(position) + [40, 42])[:, None, None]
    c, _ = covariance(at, psf_second_moment(STAR))
    found = [[(a * b * image).sum() for a in (y, x)] for b in (y, x)]
    np.testing.assert_allclose(found, c, rtol=1e-3)
    root = np.sqrt(1 + 0.4**2 + 0.2**2)
    own = 9 * np.array([[1 + 0.4 / root, -0.2 / root], [-0.2 / root, 1 - 0.4 / root]])
    np.testing.assert_allclose(c - psf_second_moment(STAR), own, rtol=1e-12)


@pytest.mark.parametrize(("n", "tolerance"), [(0.5, 0.03), (1, 0.03), (2.5, 0.02), (4, 0.04)])
def test_a_galaxy_far_larger_than_the_psf_is_sersics(n, tolerance):
    """By the function that astropy has of it, of the same effective radius, and its light."""
    re_px, shape = 40.0, (161, 171)
    at = parameters_of(n, re_px)
    drawn = profile(at, (80.0, 85.0), shape, 1e-12 * np.eye(2), slopes=False)[0]
    radius = np.hypot(*(np.indices(shape) - np.array([80.0, 85.0])[:, None, None]))
    wanted = Sersic1D(amplitude=1, r_eff=re_px, n=n)(radius)
    away = radius > 0.05 * re_px
    ratio = drawn[away] / wanted[away]
    assert np.abs(ratio / np.median(ratio) - 1).max() < tolerance
    one = GalaxyGaussians(at[None], 1e-12 * np.eye(2)[None])
    assert one.outside(np.array([re_px])) == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize("n", [0.6, 1, 2.5, 4])
@pytest.mark.parametrize("re_px", [0.5, 1, 4])
def test_a_galaxy_is_sersics_behind_the_psf(n, re_px):
    """As GalSim draws both; its light to 0.5 % of the peak."""
    shape, q = (81, 81), 0.6
    galaxy = galsim.Sersic(n, half_light_radius=re_px).shear(q=q, beta=0 * galsim.degrees)
    seen = galsim.Convolve(galaxy, galsim.Gaussian(sigma=0.8))
    wanted = seen.drawImage(nx=81, ny=81, scale=1, method="no_pixel", dtype=float).array
    at = parameters_of(n, re_px * np.sqrt((q + 1 / q) / 2))
    at[1] = np.sinh(-np.arctanh((1 - q**2) / (1 + q**2)))
    drawn = profile(at, (40.0, 40.0), shape, 0.64 * np.eye(2), slopes=False)[0]
    assert np.abs(drawn - wanted).max() < 0.006 * wanted.max()


def parameters_of(n, re_px):
    """Of a round profile: sigma of its half-light radius, and beta of n."""
    ln_beta = np.log(min(1 / max(n - 0.5, 1e-9), 1e9) - BETA_0)
    return np.array([np.log(re_px / HALF_LIGHT**0.5), 0, 0, ln_beta])


@pytest.mark.parametrize("beta", [0.1, 2.0, 25.0])
def test_light_outside_an_ellipse_is_that_of_the_pixels_there(beta):
    """And lies beyond the level of brightness that is given for it; reaches end at a level."""
    theta, c_psf = np.array([np.log(4.0), 0.0, 0.0, np.log(beta)]), 0.64 * np.eye(2)
    place, shape = (100.3, 99.6), (200, 200)
    image = profile(theta, place, shape, c_psf, slopes=False)[0]
    one = GalaxyGaussians(theta[None], c_psf[None])
    r = np.hypot(*(np.indices(shape) - np.reshape(place, (2, 1, 1))))
    assert image.max() == pytest.approx(one.peak.sum(), rel=0.15)
    for part in (0.5, 0.2):
        (level,) = one.threshold(part)
        ((end, _),) = one.reach(level)
        assert one.outside(np.array([end])) == pytest.approx(part, rel=1e-6)
        assert 1 - image[r < end].sum() == pytest.approx(part, abs=0.01)
        assert image[r < end].min() == pytest.approx(level * one.peak.sum(), rel=0.05)


def test_the_reach_of_an_ellipse_holds_its_brightness():
    theta, c_psf = np.array([np.log(4.0), 0.6, -0.4, np.log(2.0)]), 0.64 * np.eye(2)
    image = profile(theta, (100.0, 100.0), (201, 201), c_psf, slopes=False)[0]
    for part in (0.1, 1e-3):
        half = galaxy_reach(theta[None], c_psf[None], np.array([part]))[0]
        lit = np.argwhere(image > part * image.max())
        reached = np.abs(lit - 100).max(axis=0)
        assert (reached <= half).all() and (half < 1.05 * reached + 1.5).all()


def test_moments_of_a_psf():
    """A Gaussian's own and the pixel's, 1/12, but for its aliasing; in the model's pixels."""
    np.testing.assert_allclose(
        psf_second_moment(STAR), (0.64 + 1 / 12) * np.eye(2), rtol=3e-5, atol=1e-12
    )
    fine = PSF(PSF.gaussian(3.0, n_pixels=61, pixel=False).images, spacing=0.5)
    np.testing.assert_allclose(psf_second_moment(fine), 2.25 * np.eye(2), rtol=1e-6, atol=1e-12)
    image = np.zeros((5, 5))
    image[1, 3] = image[3, 1] = 1
    image[2, 2] = 2  # its core, or PSF warns
    # 1 along one diagonal, 0 along the other one, at least a quarter
    wanted = [[0.625, -0.375], [-0.375, 0.625]]
    np.testing.assert_allclose(psf_second_moment(PSF(image)), wanted)
