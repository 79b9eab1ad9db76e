"""Images on one grid and under one PSF: light and noise against the operator's own rows."""

import warnings

import numpy as np
import pytest

from clresample import match
from clresample.resampling.matching.kernel import NoiseKernel
from clresample.resampling.matching.target import local_matrix, psf_on
from clresample.resampling.resampler import Resampler
from clresample.sky.correlation import NoiseCorrelation
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

FINE = Grid.flat((40, 44), 0.1)
SHARP, WIDE = PSF.gaussian(1.2, n_pixels=21), PSF.gaussian(1.7, n_pixels=25)


def image(grid=FINE, psf=SHARP, data=None, **given):
    rng = np.random.default_rng(1)
    data = rng.normal(size=(1, *grid.shape)) if data is None else data
    return Observation(data, psf, grid, **({"weights": 1.0, "name": "a"} | given))


def weights_by_rows(o, grid, psf, pixels, noise=None):
    """Inverse variances of pixels of the matched image, by rows of its operator."""
    op = Resampler(o.grid, o.psf, grid, psf)
    sigma = np.where(o.weights > 0, o.weights, np.inf) ** -0.5
    found = []
    for y, x in pixels:
        unit = np.zeros((1, *grid.shape), np.float32)
        unit[0, y, x] = 1
        row = (op.adjoint(unit) * sigma)[0].astype(float)
        found.append(1 / (row**2).sum())
    return np.array(found)


@pytest.mark.parametrize(
    ("grid", "psf"),
    [
        (Grid.flat((20, 22), 0.2), PSF.gaussian(1.0, n_pixels=15)),
        (Grid.flat((20, 22), 0.2, angle_deg=25), PSF.gaussian(1.0, n_pixels=15)),
        (Grid.flat((30, 30), 0.11, angle_deg=40, flip=True), PSF.gaussian(1.9, n_pixels=25)),
    ],
)
def test_the_variance_of_each_pixel_is_that_of_the_operators_row(grid, psf):
    weights = np.ones((1, *FINE.shape)) * np.linspace(0.5, 2, 44)
    weights[0, 12:14, 30:33] = 0
    o = image(weights=weights)
    m = match(o, grid, psf)
    kept = np.argwhere(m.weights[0] > 0)
    chosen = kept[:: max(1, len(kept) // 12)]
    expected = weights_by_rows(o, grid, psf, chosen)
    np.testing.assert_allclose(m.weights[0][tuple(chosen.T)], expected, rtol=0.02)
    assert 0.3 < (m.weights > 0).mean() < 0.98


def test_noise_of_neighbours_is_as_correlated_as_it_is_stated():
    rng = np.random.default_rng(0)
    m = match(image(), psf=WIDE)
    (found,) = m.noise
    op = Resampler(FINE, SHARP, FINE, WIDE)
    draws = op(rng.normal(size=(200, 1, *FINE.shape)).astype(np.float32))[:, 0, 8:-8, 8:-8]
    middle = found.autocorrelation.shape[0] // 2
    variance = (draws**2).mean()
    for dy, dx in ((0, 1), (1, 1), (2, 0), (3, 3)):
        n_y, n_x = draws.shape[1:]
        pairs = draws[:, : n_y - dy, : n_x - dx] * draws[:, dy:, dx:]
        rho = pairs.mean() / variance
        assert abs(rho - found.autocorrelation[middle + dy, middle + dx]) < 0.02


def test_correlated_noise_comes_out_as_filtered_white_noise():
    rho = NoiseCorrelation(np.outer([0.3, 1, 0.3], [0.3, 1, 0.3]))
    white, correlated = (match(image(noise=n), psf=WIDE) for n in (None, rho))
    taps = rho.colouring_filter()
    assert abs((taps**2).sum() - 1) < 1e-6
    op = Resampler(FINE, SHARP, FINE, WIDE)
    unit = np.zeros((1, *FINE.shape), np.float32)
    unit[0, 20, 22] = 1
    row = op.adjoint(unit)[0].astype(float)
    power = 0.0
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            moved = np.roll(row, (dy, dx), (0, 1))
            power += rho.autocorrelation[1 + dy, 1 + dx] * (row * moved).sum()
    np.testing.assert_allclose(1 / correlated.weights[0, 20, 22], power, rtol=0.01)
    assert correlated.weights[0, 20, 22] < 0.7 * white.weights[0, 20, 22]


def test_light_is_kept_and_a_star_has_the_psf_asked_for():
    star = np.zeros((1, *FINE.shape))
    y, x = np.indices(FINE.shape)
    at = (19.3, 21.6)
    psf = PSF.gaussian(1.0, n_pixels=15)
    pixels = Grid.flat((20, 22), 0.2, angle_deg=25)
    delta = PSF.restore(np.ones((1, 1, 1)), spacing=1, center=np.zeros((1, 2)))
    op = Resampler(FINE, delta, FINE, SHARP)
    shift = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * 0.9**2))
    star[0] = op(shift[None].astype(np.float32))[0]
    m = match(image(data=star), pixels, psf)
    np.testing.assert_allclose(m.data.sum(), star.sum(), rtol=1e-4)
    expected = Resampler(FINE, delta, pixels, psf)(shift[None].astype(np.float32))
    np.testing.assert_allclose(m.data, expected, atol=2e-4 * expected.max())


def test_the_image_of_the_widest_psf_stays_as_it_is_and_names_go_along():
    other = Grid.flat((22, 20), 0.2, angle_deg=30)
    seen = Observation(
        np.ones((2, 22, 20)), PSF.gaussian([0.9, 1.3], n_pixels=15), other,
        weights=4.0, channels=("g", "r"), zero_points=[25, 26], name="b",
    )  # fmt: skip
    m = match([image(channels=["v"], zero_points=24), seen])
    assert m.grid is other and m.channels == ("v", "g", "r")
    assert list(m.zero_points) == [24, 25, 26]
    np.testing.assert_array_equal(m.data[2], seen.data[1])
    np.testing.assert_array_equal(m.weights[2], seen.weights[1])
    assert m.noise[2].autocorrelation.size == 1 and m.noise[0].autocorrelation.size > 1


def test_a_psf_is_the_same_on_other_pixels():
    turned = Grid.flat((20, 22), 0.25, angle_deg=35)
    psf = psf_on(SHARP, FINE, turned)
    nu = np.linspace(-0.9, 0.9, 7)
    matrix = local_matrix(turned, FINE)
    expected = SHARP.otf(nu / 2.5, nu / 2.5)
    found = psf.otf(nu / 2.5, nu / 2.5, matrix)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert not np.allclose(psf.spacing, 1)


def test_nan_under_the_mask_does_not_spread():
    data = np.ones((1, *FINE.shape))
    data[0, 20, 20] = np.nan
    m = match(image(data=data), psf=WIDE)
    kept = m.weights > 0
    assert not kept[0, 20, 20] and kept[0, 20, 32] and np.isfinite(m.data).all()
    np.testing.assert_allclose(m.data[0, 12:28, 12:32], 1, atol=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"psf": SHARP}, "would sharpen channel 'a0' and raise its noise up to"),
        ({"psf": PSF.gaussian([2, 3])}, "psf has 2 bands, must have one"),
        ({"grid": Grid.flat((9, 9), 0.1, center_arcsec=(99, 99)), "psf": WIDE}, "do not overlap"),
        ({"grid": "x"}, "grid is 'x'.*must be Grid"),
    ],
)
def test_what_cannot_be_matched_is_refused(given, message):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=message):
            match(image(psf=WIDE), **given)


def test_a_kernel_that_is_none_leaves_noise_as_it_is():
    kernel = NoiseKernel(FINE, SHARP, FINE, SHARP)
    np.testing.assert_allclose(kernel.variance(np.ones((1, *FINE.shape)))[0, 20, 20], 1, rtol=0.2)
