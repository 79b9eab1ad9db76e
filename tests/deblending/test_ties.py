"""Sums over the channels of a band, and equations of bands against dense least squares."""

import numpy as np
import pytest

from clresample.deblending.linear.equations import _eliminate, _without_levels
from clresample.deblending.linear.ties import Ties, band_equations


def test_ties_sum_spread_and_average():
    assert Ties.of(["g", "r", "i"]) is None
    ties = Ties.of(["g", "r", "g", "i", "g"])
    assert ties.bands == (0, 1, 0, 2, 0) and ties.n_bands == 3
    np.testing.assert_array_equal(ties.first, [0, 1, 3])
    np.testing.assert_array_equal(ties.count, [3, 1, 3, 1, 3])
    values = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(ties.total(values, axis=0), [[12, 15], [2, 3], [6, 7]])
    np.testing.assert_array_equal(ties.mean(values.T)[1], [5, 3, 5, 7, 5])


def _random_equations(rng, ties, fit_sky):
    """Images of n spectra, a level and n p parameters of C channels, and data."""
    n_channels, n, p, pixels = len(ties.bands), 3, 4, 60
    light = rng.normal(size=(n_channels, pixels, n + 1))
    light[..., n] = 1 if fit_sky else 0
    return (
        light,
        rng.normal(size=(n_channels, pixels, n * p)),
        rng.normal(size=(n_channels, pixels)),
    )


@pytest.mark.parametrize("fit_sky", [False, True])
def test_parameters_and_spectra_of_bands_are_those_of_dense_least_squares(fit_sky):
    rng, ties, n, p = np.random.default_rng(3), Ties((0, 1, 0, 0)), 3, 4
    light, slopes, data = _random_equations(rng, ties, fit_sky)
    levels = np.eye(4)[:, None, :] * light[..., n, None]
    spectra = light[:, :, None, :n] * ties.matrix[:, None, :, None]
    jacobian = np.concatenate([slopes, spectra.reshape(4, 60, -1), levels], axis=2).reshape(240, -1)
    wanted = np.linalg.lstsq(jacobian, data.ravel(), rcond=None)[0]
    inner, rest = np.einsum("cxi,cxj->cij", light, light), np.einsum("cxi,cx->ci", light, data)
    cross = np.einsum("cxi,cxq->ciq", light, slopes).reshape(1, 4, n + 1, n, p)
    normal = np.einsum("cxp,cxq->pq", slopes, slopes).reshape(1, n, p, n, p)
    right = np.einsum("cxp,cx->p", slopes, data).reshape(1, n, p)
    parts = _without_levels(normal, right, inner[None], cross, rest[None])
    parts = [ties.total(part, axis=1) for part in parts]
    _eliminate(normal, right, *parts, np.ones((1, 2, n), bool))
    found = np.linalg.solve(normal.reshape(n * p, n * p), right.ravel())
    np.testing.assert_allclose(found, wanted[: n * p], atol=1e-6)
    gram, pull, own, value = band_equations(ties, inner, rest, fit_sky)
    found = np.linalg.solve(gram, pull[..., None])[..., 0]
    alone = np.linalg.lstsq(jacobian[:, n * p :], data.ravel(), rcond=None)[0]
    np.testing.assert_allclose(found.ravel(), alone[: 2 * n], atol=1e-9)
    if fit_sky:
        sky = value - (own * ties.spread(found, axis=0)).sum(axis=-1)
        np.testing.assert_allclose(sky, alone[2 * n :], atol=1e-9)
