"""Signal to noise at its limits: units, edges, channels that see nothing."""

import warnings

import numpy as np
import pytest

from clresample.measurement.signal_to_noise import (
    WIDTHS_ARCSEC,
    SignalToNoise,
    _gaussian,
    combine_bands,
    signal_of,
)
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

GRID = Grid.flat((60, 60), 0.1)


@pytest.mark.parametrize("unit", [1e22, 1e-22])
def test_weights_beyond_float32_are_brought_to_its_range(unit):
    rng = np.random.default_rng(5)
    data, psf = rng.normal(0, 1, GRID.shape), PSF.gaussian(1.5, n_pixels=31)
    plain, scaled = (
        signal_of(o, model_frame([o])).sums
        for o in (
            Observation(data, psf, GRID, weights=1.0),
            Observation(data * unit, psf, GRID, weights=unit**-2),
        )
    )
    np.testing.assert_allclose(scaled, plain, atol=1e-4)


@pytest.mark.filterwarnings("ignore:PSF light cut")
@pytest.mark.parametrize(
    "shape, spacing, atol",
    [((41, 13), 1.0, 1e-3), ((13, 41), 1.0, 1e-3), ((81, 25), 0.5, 0.1), ((21, 7), 2.0, 1.0)],
)
def test_light_does_not_come_back_on_the_other_side(shape, spacing, atol):
    """Of two bright edges the same as with unseen pixels all about them; samples other than pixels
    see a little beyond their PSF's edge, where it is cut."""
    along = [np.exp(-0.5 * ((np.arange(n) - n // 2) / (0.25 * n)) ** 2) for n in shape]
    psf = PSF(np.outer(*along), spacing=spacing, center=(shape[0] // 2, shape[1] // 2))
    data, inner = np.zeros((192, 192)), slice(64, 128)
    data[64, inner] = data[inner, 64] = 100.0
    weights = np.zeros(data.shape)
    weights[inner, inner] = 1
    wide = Observation(data, psf, Grid.flat(data.shape, 0.1), weights=weights)
    small = Observation(data[inner, inner], psf, Grid.flat((64, 64), 0.1), weights=1.0)
    found, wanted = (signal_of(o, model_frame([o])).sums for o in (small, wide))
    np.testing.assert_allclose(found, wanted[:, inner, inner], atol=atol)
    assert found.max() > 300


def test_where_nothing_was_seen_there_is_no_signal():
    weights = np.ones((2, *GRID.shape))
    weights[0, :, :20], weights[:, :, 45:] = 0, 0
    o = Observation(
        np.full(weights.shape, 3.0), PSF.gaussian(1.0), GRID, weights=weights, channels=("g", "r")
    )
    signal = signal_of(o, model_frame([o]))
    assert signal.n_seen[30, [5, 30, 55]].tolist() == [1, 2, 0]
    assert not signal.sums[:, :, 55:].any() and not signal.squares[:, :, 55:].any()
    one, both = (signal.sums[0, 30, x] for x in (5, 30))
    assert both == pytest.approx(2 * one, rel=1e-4)
    assert signal.squares[0, 30, 30] == pytest.approx(2 * one**2, rel=1e-4)
    assert signal.flat()[30, 30] == pytest.approx(both / np.sqrt(2))
    weights[0] = 0  # a channel without any
    dark = Observation(o.data, o.psf, GRID, weights=weights, channels=o.channels)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = signal_of(dark, model_frame([o]))
    assert alone.n_seen.max() == 1 and np.isfinite(alone.sums).all()
    assert alone.sums[0, 30, 30] == pytest.approx(one, rel=1e-4)


@pytest.mark.parametrize("ratio, is_seen", [(9, True), (300, True), (1e4, True), (1e6, False)])
def test_shallow_pixels_are_seen_and_those_of_almost_no_weight_are_not(ratio, is_seen):
    """The part of the filter on pixels with weight counts, not the ratio of weights."""
    weights = np.ones(GRID.shape)
    weights[:, 30:] = 1 / ratio
    o = Observation(np.zeros(GRID.shape), PSF.gaussian(1.5, n_pixels=31), GRID, weights=weights)
    seen = signal_of(o, model_frame([o])).n_seen > 0
    assert seen[:, :30].all() and (seen[:, 35:] == is_seen).all()


def test_channels_are_those_of_the_narrowest_filter():
    rng = np.random.default_rng(6)
    psf = PSF.gaussian([1.0, 2.0], n_pixels=31)
    o = Observation(rng.normal(size=(2, 60, 60)), psf, GRID, weights=1.0, channels=("g", "r"))
    signal = signal_of(o, model_frame([o]))
    np.testing.assert_allclose(signal.channels.sum(axis=0), signal.sums[0], atol=1e-5)
    squares = (np.maximum(signal.channels, 0) ** 2).sum(axis=0)
    np.testing.assert_allclose(signal.squares[0], squares, atol=1e-4)
    assert np.abs(signal.sums[1] - signal.sums[0]).max() > 0.1


def test_filters_are_transforms_of_gaussians():
    x = np.arange(-32, 32)
    for sigma in (2.0, 4.0):
        image = np.exp(-0.5 * (x / sigma) ** 2)
        image = np.fft.fft(np.fft.ifftshift(image / image.sum())).real
        np.testing.assert_allclose(_gaussian(np.fft.fftfreq(64), sigma), image, atol=1e-6)


def test_scatter_is_that_of_the_negative_pixels_and_at_least_one():
    """The better filter for correlated noise has more; without any noise it is 1."""
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(200, 200)).astype(np.float32)
    noise[:20] += 500  # sources are positive
    sums = np.stack([0.3 * noise, 3 * noise, np.full_like(noise, 4)])
    places = np.moveaxis(np.indices(noise.shape), 0, -1)
    one = SignalToNoise(sums, sums**2, np.full(noise.shape, 4), sums[:1], places, noise < np.inf)
    np.testing.assert_allclose(one.scatters(), [1, 1.5, 1], rtol=0.05)
    over = one.divided_by(one.scatters())
    np.testing.assert_allclose(over.flat(1), one.flat(1) / one.scatters()[1], rtol=1e-6)


def test_observations_together_count_all_their_channels():
    """The first image is of the narrowest filter, the second the best of all."""
    shape = (2, 3)
    places = np.moveaxis(np.indices(shape), 0, -1)

    def signal(n, *sums):
        found = np.broadcast_to(np.array(sums, np.float32)[:, None, None], (len(sums), *shape))
        return SignalToNoise(
            found, 0 * found, np.full(shape, n), found[:1], places, found[0] < np.inf
        )

    assert len(WIDTHS_ARCSEC) == 3
    first, best = combine_bands([signal(1, 3, 4, 8), signal(3, 5, 2, 6)])
    np.testing.assert_allclose(first, 4)
    np.testing.assert_allclose(best, 7)
