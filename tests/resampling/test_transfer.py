"""The division of two OTFs, how far its kernel reaches, and what a user is warned of."""

import math
import warnings

import numpy as np
import pytest

from clresample.paper.operator.sincs import sinc_transfer
from clresample.resampling.transfer import (
    DIVISION_FLOOR,
    FLOORED_POWER,
    NOISY_GAIN,
    WRAP_MARGIN,
    Certificate,
    floor_warnings,
    gain_warnings,
    transfer_function,
    wrap_radius,
)
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning


def test_the_ratio_is_exact_above_the_floor_and_falls_below_it():
    size = np.array([1.0, 0.1, 2 * DIVISION_FLOOR, 0.5 * DIVISION_FLOOR, 0.0])
    p1 = (size * np.exp(1j * np.arange(5))).reshape(1, 1, 5)
    p2 = np.array([0.5, 1j, -1e-3, 1e-3, 1e-3]).reshape(1, 1, 5)
    ratio, gain, floored = transfer_function(p1, p2)
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = p2 / p1
    np.testing.assert_allclose(ratio[..., :3], exact[..., :3], rtol=1e-14)
    np.testing.assert_allclose(ratio[..., 3], 0.25 * exact[..., 3], rtol=1e-14)
    assert ratio[0, 0, 4] == 0
    assert gain == pytest.approx([1e-3 / (2 * DIVISION_FLOOR)])
    power = np.abs(p2[0, 0]) ** 2
    assert floored == pytest.approx([power[3:].sum() / power.sum()])


def test_one_band_serves_all():
    p1, p2 = np.full((1, 2, 3), 0.5), np.arange(1, 4)[:, None, None] * np.ones((3, 2, 3))
    ratio, gain, floored = transfer_function(p1, p2)
    np.testing.assert_array_equal(ratio, 2 * p2)
    np.testing.assert_array_equal(gain, (2, 4, 6))
    assert floored.shape == (3,) and not floored.any()


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_wrap_radius_of_a_gaussian(sigma):
    psf = PSF.gaussian(sigma, n_pixels=61, pixel=False)
    # 1e-5 of its light lies beyond 4.8 sigma: exp(-r^2 / 2)
    reach = math.sqrt(2 * math.log(1e5)) * sigma
    for scale in (1.0, 2.5):
        radius = wrap_radius(psf, scale * np.eye(2))
        np.testing.assert_allclose(radius, scale * (WRAP_MARGIN * reach + 1), atol=1.6 * scale)
    # a small image ends before: half a sample beyond its last ones
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        small = PSF(np.ones((3, 5)) / 15)
    np.testing.assert_allclose(wrap_radius(small, np.eye(2)), (1.5, 2.5))


def certificate(gain, floored):
    gain, floored = np.array([1.0, gain]), np.array([0.0, floored])
    return Certificate((3.0, 4.0), (21, 23), (5, 6), gain, floored)


def test_what_is_warned_of():
    assert gain_warnings(certificate(NOISY_GAIN, 0.25)) == []
    assert floor_warnings(certificate(3, FLOORED_POWER)) == []
    (gain,) = gain_warnings(certificate(12.345, 0))
    assert "amplifies some frequencies 12.3 times" in gain
    (floored,) = floor_warnings(certificate(1, 0.25))
    assert "25.00%" in floored and "the division is floored" in floored


def test_wrap_radius_of_turned_pixels_that_are_not_square():
    """Observed displacements u of length r reach r |A_y| along the model's y, r |A_x| along x."""
    psf = PSF.gaussian(1.5, n_pixels=61, pixel=False)
    for matrix in ([[2.0, 1.0], [0.0, 0.5]], [[0.3, 1.9], [-0.6, 0.2]]):
        y, x = wrap_radius(psf, np.array(matrix))
        assert y / x == pytest.approx(np.hypot(*matrix[0]) / np.hypot(*matrix[1]))


def test_the_papers_psf_of_finer_pixels_does_not_fold_back(device):
    """It fills their band, which is wider than the model's; the sincs' cut leaves under 1 %."""
    n_fft, psf_in, psf_out = (65, 67), PSF.gaussian(0.8), PSF.gaussian(0.7)
    found, *_ = sinc_transfer(device, 0.5 * np.eye(2), psf_in, psf_out, n_fft)
    nu = [np.fft.fftfreq(n) for n in n_fft]
    wanted = 0.25 * psf_out.otf(*(0.5 * n for n in nu)) / psf_in.otf(*nu)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-2 * np.abs(wanted).max())
