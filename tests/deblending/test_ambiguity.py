"""Whose light it is: analytic pairs of unresolved sources, and what their fluxes' errors are."""

import numpy as np
import pytest

from clresample.deblending.assessment.ambiguity import is_ambiguous, partners


def pair(widths, snr, *, ratio=1.0):
    """Fluxes (1, 2) and their covariance (1, 2, 2) of two stars so many PSF widths (FWHM) apart.

    The second is `ratio` times the first, which alone would have a signal to noise of `snr`.
    """
    sigmas = widths * np.sqrt(8 * np.log(2))
    overlap = np.exp(-(sigmas**2) / 4)  # of Gaussian PSFs, each of unit norm
    normal = np.array([[1, overlap], [overlap, 1]])
    return np.array([[snr, snr * ratio]]), np.linalg.inv(normal)[None]


@pytest.mark.parametrize(
    "widths, snr, ratio, wanted",
    [
        (0.2, 8, 1.0, [True, True]),
        (3.0, 8, 1.0, [False, False]),  # as well known as alone
        (3.0, 2, 1.0, [False, False]),  # noise
        (0.2, 200, 1.0, [False, False]),  # bright enough to be told apart
        (0.2, 40, 0.1, [False, True]),  # the faint one alone may be the other's light
        (0.2, 1, 1.0, [False, False]),  # there is no light
    ],
)
def test_two_stars(widths, snr, ratio, wanted):
    flux, covariance = pair(widths, snr, ratio=ratio)
    assert is_ambiguous(flux, covariance).tolist() == wanted
    assert is_ambiguous(flux[:, ::-1], covariance[:, ::-1, ::-1]).tolist() == wanted[::-1]


def test_the_channel_that_tells_best_decides():
    near, far = pair(0.2, 8), pair(3.0, 40)
    flux, covariance = (np.concatenate(both) for both in zip(near, far, strict=True))
    assert not is_ambiguous(flux, covariance).any()
    covariance[1] = np.inf  # not seen in it
    assert is_ambiguous(flux, covariance).all()
    assert not is_ambiguous(flux[1:], covariance[1:]).any()


def test_light_that_the_other_one_has_in_every_bright_channel():
    """A channel in which both are faint is no reason that the others do not count."""
    near, faint = pair(0.2, 8), pair(0.2, 1)
    flux, covariance = (np.concatenate(both) for both in zip(near, faint, strict=True))
    flux[0] = -3, 19  # the second one has the light of both
    assert is_ambiguous(flux, covariance)[0]


def test_a_bright_neighbours_own_error_is_no_exchange():
    flux, covariance = pair(0.2, 8, ratio=100.0)
    assert is_ambiguous(flux, covariance).tolist() == [True, False]
    covariance[0, 1, 1] += 30**2  # of 800
    assert is_ambiguous(flux, covariance).tolist() == [True, False]
    flux, covariance = pair(3.0, 8, ratio=100.0)
    covariance[0, 0, 0] += 4**2  # its own
    assert not is_ambiguous(flux, covariance).any()


def test_partners_are_those_that_exchange_most():
    """Source 0 alone, 1 and 3 a pair; 2 has no coverage."""
    flux, covariance = np.full((4, 1), 8.0), np.eye(4)[None].copy()
    covariance[0][np.ix_([1, 3], [1, 3])] = pair(0.2, 8)[1][0]
    covariance[0, 2, 2] = np.inf
    covariance[0, 0, 1] = covariance[0, 1, 0] = -0.1
    assert partners(flux, covariance).tolist() == [-1, 3, -1, 1]
    assert partners(flux[:1], covariance[:, :1, :1]).tolist() == [-1]
