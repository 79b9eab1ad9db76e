"""Least squares and covariances of spectra, where sources lie apart or in one place."""

import numpy as np
import pytest
from scipy.optimize import nnls

from clresample.deblending.linear import spectra
from clresample.deblending.linear.spectra import (
    RIDGE,
    nnls_batch,
    portions,
    solve_in_place,
    spectrum_covariance,
    unit_diagonal,
)


def test_sources_in_one_place_have_variances_though_rounding_made_the_matrix_indefinite():
    """Forty times two stars: float32 leaves eigenvalues below zero."""
    rng = np.random.default_rng(1)
    images = rng.random((2, 50))[np.arange(80) % 2]
    noise = rng.normal(0, 3e-7, (80, 80))
    normal = ((images @ images.T) * (1 + noise + noise.T))[None]
    assert np.linalg.eigvalsh(unit_diagonal(normal)[0]).min() < -RIDGE
    found = spectrum_covariance(normal)[0]
    alone = 1 / np.diag(normal[0])
    assert np.isfinite(found).all()
    assert (np.diag(found) > 1e5 * alone).all()  # neither is known without the others
    assert np.linalg.eigvalsh(found / np.abs(found).max()).min() > -1e-12


def test_a_matrix_that_is_well_defined_is_inverted_as_it_is():
    rng = np.random.default_rng(2)
    images = rng.normal(size=(3, 5, 40)) * np.array([1, 10, 0.1, 3, 1])[:, None]
    normal = images @ images.swapaxes(1, 2)
    normal[1, 2] = normal[1, :, 2] = 0  # one that this channel does not see
    found = spectrum_covariance(normal)
    np.testing.assert_allclose(found[0], np.linalg.inv(normal[0]), rtol=1e-5)
    assert found[1, 2, 2] == np.inf and not found[1, 2, [0, 1, 3, 4]].any()
    others = np.ix_([0, 1, 3, 4], [0, 1, 3, 4])
    np.testing.assert_allclose(found[1][others], np.linalg.inv(normal[1][others]), rtol=1e-5)


def test_no_variance_is_less_than_that_of_a_source_alone():
    """A source alone: 1 / N, to the ridge."""
    found = spectrum_covariance(np.array([[[4.0]], [[25.0]]]))
    np.testing.assert_allclose(found[:, 0, 0], [1 / 4, 1 / 25], rtol=2 * RIDGE)


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_meet_the_conditions_of_a_minimum(seed):
    """x >= 0, gradient 0 where x > 0 and not below 0 elsewhere; SciPy finds the same."""
    rng = np.random.default_rng(seed)
    images = rng.normal(size=(4, 7, 30))
    data = rng.normal(size=(4, 30))
    normal, right = images @ images.swapaxes(1, 2), np.einsum("mij,mj->mi", images, data)
    found = nnls_batch(normal, right)
    truth = [nnls(a.T, d)[0] for a, d in zip(images, data, strict=True)]
    np.testing.assert_allclose(found, truth, atol=1e-6)
    assert (found == 0).any() and (found > 0).any()


def test_what_is_not_seen_is_zero():
    normal = np.diag([2.0, 4.0, 0.0])[None]
    right = np.array([[-2.0, -4.0, 0.0]])
    np.testing.assert_allclose(nnls_batch(normal, right), 0)
    np.testing.assert_allclose(nnls_batch(normal, -right), [[1, 1, 0]], rtol=1e-7)


def test_equal_sources_share_their_light():
    found = nnls_batch(np.ones((1, 2, 2)), np.full((1, 2), 6.0))
    np.testing.assert_allclose(found, [[3, 3]], rtol=1e-6)


def crowded(n=120, n_pixels=90):
    """Faint stars on each other in a small image, float32's rounding."""
    rng = np.random.default_rng(8)
    y, x = rng.uniform(0, 9, (2, n, 1))
    row, column = np.divmod(np.arange(n_pixels), 9)
    images = np.exp(-((row - y) ** 2 + (column - x) ** 2) / 8)
    data = 100 * images[::40].sum(axis=0) - 0.3 + rng.normal(0, 0.1, n_pixels)
    normal = (images @ images.T).astype(np.float32).astype(float)
    return images, data, normal, images @ data


def test_sources_that_cannot_be_told_apart_get_a_minimum_all_the_same():
    """More of them than pixels: exchanges of whole sets go round in circles."""
    images, data, normal, right = crowded()
    assert np.linalg.eigvalsh(unit_diagonal(normal)[0]).min() < 0
    (found,) = nnls_batch(normal[None], right[None])
    assert (found >= 0).all() and np.isfinite(found).all()
    _, least = nnls(images.T, data)
    assert np.linalg.norm(data - found @ images) == pytest.approx(least, rel=0.01)


def test_problems_that_settle_and_that_do_not_are_solved_together():
    _, _, normal, right = crowded()
    apart = np.eye(len(right)) * 4
    found = nnls_batch(np.stack([apart, normal, apart]), np.stack([right, right, -right]))
    np.testing.assert_allclose(found[0], right / 4, rtol=1e-7)
    np.testing.assert_array_equal(found[1], nnls_batch(normal[None], right[None])[0])
    assert not found[2].any()


def test_matrices_that_rounding_spoiled_harm_no_others():
    """Each as if alone, where few and where all of them are spoiled."""
    rng = np.random.default_rng(6)
    images = rng.random((2, 50))[np.arange(20) % 2]
    noise = rng.normal(0, 3e-7, (20, 20))
    spoiled = (images @ images.T) * (1 + noise + noise.T)
    apart = rng.normal(size=(20, 50))
    normal = np.stack([apart @ apart.T, spoiled, 4 * spoiled])
    assert (np.linalg.eigvalsh(unit_diagonal(normal)[0])[:, 0] < 0).tolist() == [False, True, True]
    found = spectrum_covariance(normal)
    for one, own in zip(found, normal, strict=True):
        np.testing.assert_allclose(one, spectrum_covariance(own[None])[0], rtol=1e-6)
    variance = np.diagonal(found, axis1=1, axis2=2) * np.diagonal(normal, axis1=1, axis2=2)
    assert (variance > 0.99).all()


def test_portions_change_no_result(monkeypatch):
    rng = np.random.default_rng(9)
    images = rng.normal(size=(7, 4, 20))
    normal, right = images @ images.swapaxes(1, 2), rng.normal(size=(7, 4))
    whole = nnls_batch(normal, right), spectrum_covariance(normal)
    monkeypatch.setattr(spectra, "PORTION_BYTES", 3 * normal[0].nbytes)
    assert portions(7, normal[0].nbytes) == [slice(0, 3), slice(3, 6), slice(6, 7)]
    assert portions(2, 4 * normal[0].nbytes) == [slice(0, 1), slice(1, 2)] and portions(0, 8) == []
    for found, wanted in zip((nnls_batch(normal, right), spectrum_covariance(normal)), whole):
        np.testing.assert_array_equal(found, wanted)


def test_matrices_are_solved_in_their_own_memory():
    rng = np.random.default_rng(10)
    matrix, right = rng.normal(size=(5, 5)), rng.normal(size=5)
    matrix += matrix.T
    before = matrix.copy()
    np.testing.assert_allclose(before @ solve_in_place(matrix, right), right, atol=1e-12)
    assert (matrix != before).any()
    with pytest.raises(np.linalg.LinAlgError):
        solve_in_place(np.zeros((2, 2)), np.ones(2))
