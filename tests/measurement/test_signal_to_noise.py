"""Signal to noise under filters of several widths, and of all channels together."""

import numpy as np
import pytest
from scipy import stats

from clresample.measurement import signal_to_noise as module
from clresample.measurement.signal_to_noise import (
    WIDTHS_ARCSEC,
    SignalToNoise,
    combine_bands,
    signal_of,
    significance,
)
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

SHARP, BLURRED = Grid.flat((91, 91), 0.1), Grid.flat((61, 61), 0.2, angle_deg=20)


def observed(data, grid, sigma):
    data = np.asarray(data, float)
    data = data[None] if data.ndim == 2 else data
    return Observation(data, PSF.gaussian(sigma, n_pixels=41), grid, weights=1.0)


def gaussian_at(grid, sigma_px, center_arcsec=(0.0, 0.0)):
    """A Gaussian of unit sum about a place on the sky, of sigma in pixels of the grid."""
    y, x = np.indices(grid.shape)
    there = np.linalg.solve(grid.jacobian, np.array(center_arcsec) - grid.origin)
    image = np.exp(-0.5 * ((y - there[0]) ** 2 + (x - there[1]) ** 2) / sigma_px**2)
    return image / image.sum()


@pytest.mark.parametrize(("grid", "scale"), [(SHARP, 0.1), (BLURRED, 0.2)])
@pytest.mark.parametrize("width", range(len(WIDTHS_ARCSEC)))
def test_each_filter_is_the_best_for_light_of_its_width(grid, scale, width):
    """Signal to noise at the middle is flux |template|, that of the best possible filter."""
    sigma = np.hypot(1.6, WIDTHS_ARCSEC[width] / scale)
    template = gaussian_at(grid, sigma)
    one = observed(300.0 * template, grid, 1.6)
    frame = model_frame([one], grid=SHARP)
    images = signal_of(one, frame).sums
    best = 300.0 * np.sqrt((template**2).sum())
    assert images[width].max() == pytest.approx(best, rel=0.03)
    assert images.max() < 1.03 * best


def test_noise_has_unit_scatter_under_every_filter():
    frame = model_frame([observed(np.zeros(BLURRED.shape), BLURRED, 1.7)], grid=SHARP)
    squares = np.zeros(len(WIDTHS_ARCSEC))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        one = observed(rng.normal(0, 1, (3, *BLURRED.shape)), BLURRED, 1.7)
        signal = signal_of(one, frame)
        flats = np.stack([signal.flat(w) for w in range(len(squares))])[:, 20:70, 20:70]
        squares += (flats**2).mean(axis=(1, 2)) / 30
    np.testing.assert_allclose(np.sqrt(squares), 1, atol=0.08)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_significance_is_as_rare_as_it_says(n):
    rng = np.random.default_rng(n)
    squares = (np.maximum(rng.normal(size=(400_000, n)), 0) ** 2).sum(axis=1)
    sigmas = significance(squares, np.full(len(squares), n))
    for limit in (1.0, 2.0, 3.0):
        expected = stats.norm.sf(limit)
        assert (sigmas > limit).mean() == pytest.approx(expected, rel=0.15)


def test_significance_goes_on_beyond_its_table():
    q = np.array([399.0, 401.0, 1e4])
    sigmas = significance(q, np.array([7, 7, 7]))
    assert (np.diff(sigmas) > 0).all()
    assert sigmas[1] - sigmas[0] == pytest.approx(np.sqrt(401) - np.sqrt(399), rel=0.3)
    assert sigmas[2] == pytest.approx(100, rel=0.05)
    below, above = significance(module.TABLE_END + np.array([-1e-3, 0]), np.array([7, 7]))
    assert above == pytest.approx(below, abs=1e-4)  # one step of the table is 6e-3
    assert significance(np.array([50.0]), np.array([0]))[0] == 0
    mixed = significance(np.array([50.0, 50.0, 50.0]), np.array([0, 1, 7]))
    assert mixed[0] == 0 and mixed[1] > mixed[2] > 5


def signal(each, seen):
    """A Signal of channels (C, Ny, Nx) under the narrowest filter, nothing under the others."""
    each, n_seen = np.asarray(each, np.float32), np.sum(seen, axis=0, dtype=int)
    sums, squares = (np.zeros((len(WIDTHS_ARCSEC), *n_seen.shape), np.float32) for _ in range(2))
    sums[0], squares[0] = each.sum(axis=0), (np.maximum(each, 0) ** 2).sum(axis=0)
    places = np.moveaxis(np.indices(n_seen.shape), 0, -1).astype(float)
    return SignalToNoise(sums, squares, n_seen, each, places, n_seen > 0)


def test_light_in_one_band_of_seven_is_more_significant_than_its_share_of_the_sum():
    each = np.zeros((7, 1, 2))
    each[3, 0, 0] = 8.0  # in one band
    each[:, 0, 1] = 8.0 / np.sqrt(7)  # the same in all
    first, best = combine_bands([signal(each, np.ones((7, 1, 2)))])
    np.testing.assert_allclose(first[0], [8 / np.sqrt(7), 8], rtol=1e-6)
    assert best[0, 0] > 5 and best[0, 1] == pytest.approx(8, rel=1e-6)


def test_channels_that_have_not_seen_a_place_do_not_dilute_it():
    one = signal([[[6.0]], [[0.0]]], [[[1]], [[0]]])
    assert combine_bands([one])[0][0, 0] == 6 and one.flat()[0, 0] == 6


def test_spectra_are_those_of_the_nearest_observed_pixels():
    one = signal(np.arange(12.0).reshape(2, 2, 3), np.ones((2, 2, 3)))
    at = np.array([(0, 2), (1, 0), (-3, 9)])
    np.testing.assert_array_equal(one.spectra(at), [(2, 8), (3, 9), (2, 8)])
    one.places[0, 2] = (0, 40)
    np.testing.assert_array_equal(one.spectra(at[:1]), [(0, 0)])
    for beyond in ((2, 1), (-1, 1), (1, 3), (1, -1)):
        one.places[0, 2] = beyond
        np.testing.assert_array_equal(one.spectra(at[:1]), [(0, 0)])


def test_in_units_of_the_scatter():
    one = signal([[[6.0]], [[2.0]]], np.ones((2, 1, 1))).divided_by([2.0, 1.0, 1.0])
    assert one.flat()[0, 0] == pytest.approx(4 / np.sqrt(2))
    assert one.squares[0, 0, 0] == 10 and one.channels[0, 0, 0] == 3


@pytest.mark.parametrize("n_channels", [1, 5])
def test_channels_are_the_same_together_and_one_by_one(monkeypatch, n_channels):
    """To the last bit: tiles of a field go one by one, blends all at once."""
    rng = np.random.default_rng(2)
    data = (
        rng.normal(0, 1, (n_channels, *BLURRED.shape))
        * np.logspace(0, 6, n_channels)[:, None, None]
    )
    weights = rng.uniform(0, 2, data.shape) * (rng.random(data.shape) > 0.05)
    weights[-1, :30] = 0
    psf = PSF.gaussian(np.linspace(1.2, 2.0, n_channels), n_pixels=31)
    one = Observation(data, psf, BLURRED, weights=weights)
    frame = model_frame([one], grid=SHARP)
    found = []
    for together in (1, 3 * 120 * 120, 1 << 30):
        monkeypatch.setattr(module, "TOGETHER_PX", together)
        found.append(signal_of(one, frame))
    for other in found[1:]:
        for name in ("sums", "squares", "n_seen", "channels"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))
    assert np.isfinite(found[0].sums).all() and found[0].sums.any()
