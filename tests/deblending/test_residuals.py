"""Structured residuals: measured in sigmas, given to the source they lie on, flagged, reported."""

from dataclasses import replace

import numpy as np
import pytest

from clresample import PSF, ExtendedSource, Frame, Grid, Observation, Resampler, Settings, deblend
from clresample.deblending.posterior import posterior, residuals
from clresample.deblending.posterior.residuals import (
    MISFIT_SIGMAS,
    channel_residuals,
    max_filtered_residuals,
    misfit_error_scale,
)
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.photometry import channel_covariances, fluxes
from clresample.measurement.quality import summary

POSITIONS = [(16.0, 14.0), (28.0, 31.0)]
GRID, FRAME_PSF, SEEN = Grid.flat((46, 44), 0.1), PSF.gaussian(0.8), PSF.gaussian([1.3, 1.5])
SIGMA = 2.0  # [counts] noise of a pixel


def over_5_sigma(residuals):
    """Sources (S,) bool with such a residual in any channel."""
    return (residuals > MISFIT_SIGMAS).any(axis=1)


def fitted():
    """Two round galaxies in two channels, fitted where there is no noise at all."""
    y, x = np.indices(GRID.shape)
    model = sum(np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * 2.0**2)) for a, b in POSITIONS)
    data = Resampler(GRID, FRAME_PSF, GRID, SEEN, dtype=np.float64)(np.stack([90 * model] * 2))
    seen = Observation(data, SEEN, GRID, weights=SIGMA**-2, channels=["g", "r"])
    sources = [ExtendedSource(position_px=p) for p in POSITIONS]
    return deblend([seen], sources, frame=Frame(GRID, FRAME_PSF), settings=Settings(max_iter=20))


@pytest.fixture(scope="module")
def result():
    return fitted()


def left_over(result, *, bump, noise=0.0, seed=0):
    """The result, without Errors, had a point source of `bump` sigma been missed on source 1 in
    channel r."""
    o, rng = result.observations[0], np.random.default_rng(seed)
    psf = SEEN.images[1]
    point = np.zeros(o.shape)
    point[1, 28 - 20 : 28 + 18, 31 - 20 : 31 + 13] = psf[:38, :33]
    data = result.model(0) + bump * SIGMA * point / np.sqrt((psf**2).sum())
    data = data + noise * rng.normal(size=o.shape)
    seen = Observation(data, o.psf, o.grid, weights=o.weights, channels=o.channels)
    return replace(result, observations=(seen,), errors=None)


def test_a_residual_is_measured_in_sigmas_and_given_to_its_source(result):
    found = max_filtered_residuals(left_over(result, bump=-8), 0)
    assert found.shape == (2, 2)
    assert found[1, 1] == pytest.approx(8, rel=0.03)
    assert found[1, 0] < 0.5 and found[0].max() < 3  # the other channel, the other source


def test_it_is_flagged_and_the_fit_is_not_called_good(result):
    found = left_over(result, bump=8)
    table = catalogue(found)
    assert (table["flags"] & Flag.MISFIT != 0).tolist() == [False, True]
    assert table["max_residual_r"][1] == pytest.approx(8, rel=0.03)
    assert over_5_sigma(channel_residuals(found)).tolist() == [False, True]
    ended = summary(replace(found, status="converged"))
    assert ended["misfits"] == [1] and not ended["good"]
    assert summary(replace(left_over(result, bump=0), status="converged"))["good"]


@pytest.mark.parametrize("worst, factor", [(4.5, 1), (20.0, 4), (40.0, 8)])
def test_errors_of_a_misfitted_source_grow_with_its_residual(result, monkeypatch, worst, factor):
    """In proportion, from 5 sigma on, and with them its covariances, its map and what is drawn of
    it; those of the other source, and all values, stay."""
    left = np.array([[1.0, np.nan], [0.5, worst]])
    monkeypatch.setattr(posterior, "channel_residuals", lambda result: left)
    one, factors = fitted(), np.array([1, factor])
    plain, found = catalogue(result), catalogue(one)
    errors = [name for name in found.colnames if "_err" in name and name != "position_angle_err"]
    assert len(errors) == 9  # places on the sky and in pixels, size, e1, e2, two fluxes
    for name in errors:
        ratio = np.asarray(found[name], float) / np.asarray(plain[name], float)
        np.testing.assert_allclose(ratio, factors, rtol=1e-12, err_msg=name)
    for name in ("flux_g", "y_centroid", "rms_size", "e1"):
        np.testing.assert_array_equal(found[name], plain[name])
    np.testing.assert_array_equal(found["max_residual_r"], left[:, 1])
    ratio = channel_covariances(one) / channel_covariances(result)
    np.testing.assert_allclose(ratio, np.tile(factors[:, None, None] ** 2, (1, 2, 2)), rtol=1e-12)
    wanted = fluxes(result)[1] * np.outer(factors, factors)
    np.testing.assert_allclose(fluxes(one)[1], wanted, rtol=1e-12)
    drawn = [r.draws.draw(np.random.default_rng(1)) for r in (one, result)]
    for s, by in enumerate(factors):
        np.testing.assert_allclose(one.errors.morphology[s], by * result.errors.morphology[s])
        for ours, theirs in zip(*drawn, strict=True):  # morphologies, spectra
            np.testing.assert_allclose(ours[s], by * theirs[s], rtol=1e-12)


def test_errors_grow_with_the_largest_residual_of_all_channels():
    seen = np.array([[1.0, 4.9], [np.nan, 15.0], [np.nan, np.nan], [10.0, 2.0]])
    np.testing.assert_allclose(misfit_error_scale(seen), [1, 3, 1, 2])


def test_noise_alone_is_not_flagged(result):
    flagged = [
        over_5_sigma(channel_residuals(left_over(result, bump=0, noise=SIGMA, seed=i)))
        for i in range(40)
    ]
    assert np.mean(flagged) < 0.05
    worst = [
        max_filtered_residuals(left_over(result, bump=0, noise=SIGMA, seed=i), 0) for i in range(40)
    ]
    assert 2 < np.median(worst) < 4  # the largest of some hundred independent draws


def test_noise_larger_than_stated_does_not_flag_everything(result):
    found = left_over(result, bump=0, noise=3 * SIGMA)
    assert not over_5_sigma(channel_residuals(found)).any()


def test_channels_are_filtered_the_same_together_and_one_by_one(result, monkeypatch):
    one = left_over(result, bump=8.0, noise=SIGMA)
    found = []
    for together in (1, 1 << 30):
        monkeypatch.setattr(residuals, "TOGETHER_PX", together)
        found.append(max_filtered_residuals(one, 0))
    np.testing.assert_array_equal(*found)
    assert np.isfinite(found[0]).all()
