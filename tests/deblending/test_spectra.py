"""Least squares and covariances of spectra, where sources lie apart or in one place."""

import numpy as np
import pytest

from clresample.deblending.spectra import RIDGE, inverse, non_negative, scaled


def test_sources_in_one_place_have_variances_though_rounding_made_the_matrix_indefinite():
    """Forty times two stars: float32 leaves eigenvalues below zero."""
    rng = np.random.default_rng(1)
    images = rng.random((2, 50))[np.arange(80) % 2]
    noise = rng.normal(0, 3e-7, (80, 80))
    normal = ((images @ images.T) * (1 + noise + noise.T))[None]
    assert np.linalg.eigvalsh(scaled(normal)[0]).min() < -RIDGE
    found = inverse(normal)[0]
    alone = 1 / np.diag(normal[0])
    assert np.isfinite(found).all()
    assert (np.diag(found) > 1e5 * alone).all()  # neither is known without the others
    assert np.linalg.eigvalsh(found / np.abs(found).max()).min() > -1e-12


def test_a_matrix_that_is_well_defined_is_inverted_as_it_is():
    rng = np.random.default_rng(2)
    images = rng.normal(size=(3, 5, 40)) * np.array([1, 10, 0.1, 3, 1])[:, None]
    normal = images @ images.swapaxes(1, 2)
    normal[1, 2] = normal[1, :, 2] = 0  # one that this channel does not see
    found = inverse(normal)
    np.testing.assert_allclose(found[0], np.linalg.inv(normal[0]), rtol=1e-5)
    assert found[1, 2, 2] == np.inf and not found[1, 2, [0, 1, 3, 4]].any()
    others = np.ix_([0, 1, 3, 4], [0, 1, 3, 4])
    np.testing.assert_allclose(found[1][others], np.linalg.inv(normal[1][others]), rtol=1e-5)


def test_no_variance_is_less_than_that_of_a_source_alone():
    """A source alone: 1 / N, to the ridge."""
    found = inverse(np.array([[[4.0]], [[25.0]]]))
    np.testing.assert_allclose(found[:, 0, 0], [1 / 4, 1 / 25], rtol=2 * RIDGE)


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_meet_the_conditions_of_a_minimum(seed):
    """x >= 0, gradient 0 where x > 0 and not below 0 elsewhere; SciPy finds the same."""
    from scipy.optimize import nnls

    rng = np.random.default_rng(seed)
    images = rng.normal(size=(4, 7, 30))
    data = rng.normal(size=(4, 30))
    normal, right = images @ images.swapaxes(1, 2), np.einsum("mij,mj->mi", images, data)
    found = non_negative(normal, right)
    truth = [nnls(a.T, d)[0] for a, d in zip(images, data, strict=True)]
    np.testing.assert_allclose(found, truth, atol=1e-6)
    assert (found == 0).any() and (found > 0).any()


def test_free_unknowns_may_be_negative_and_what_is_not_seen_is_zero():
    normal = np.diag([2.0, 4.0, 0.0])[None]
    right = np.array([[-2.0, -4.0, 0.0]])
    free = np.array([False, True, False])
    np.testing.assert_allclose(non_negative(normal, right, free), [[0, -1, 0]], rtol=1e-7)
    np.testing.assert_allclose(non_negative(normal, -right), [[1, 1, 0]], rtol=1e-7)


def test_equal_sources_share_their_light():
    found = non_negative(np.ones((1, 2, 2)), np.full((1, 2), 6.0))
    np.testing.assert_allclose(found, [[3, 3]], rtol=1e-6)
