"""Correlated noise: known kernels come back, filtered noise gives errors that are right."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from clresample.resampling.resampler import Resampler
from clresample.sky.correlation import NoiseCorrelation
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

N = 160  # [px] a side: large enough for the correlation to be known to 2 %


def lanczos(shift, order=3):
    x = np.arange(-order, order + 1) - shift
    kernel = np.where(np.abs(x) < order, np.sinc(x) * np.sinc(x / order), 0)
    return kernel / kernel.sum()


KERNELS = {
    "white": np.ones((1, 1)),
    "drizzle": np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25]),
    "Lanczos": np.outer(lanczos(0.5), lanczos(0.3)),
    "two pixels": np.ones((2, 2)) / 4,
}


def correlation(kernel):
    """The exact autocorrelation of white noise convolved by a kernel."""
    return fftconvolve(kernel, kernel[::-1, ::-1])


def noise(kernel, rng, n=1):
    """Images (n, N, N) of unit variance."""
    reach = max(kernel.shape) - 1
    white = rng.normal(size=(n, N + reach, N + reach))
    images = fftconvolve(white, kernel[None], mode="valid", axes=(1, 2))
    return images[:, :N, :N] / np.sqrt((kernel**2).sum())


def star(sigma):
    reach = int(np.ceil(5 * sigma))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.exp(-(y**2 + x**2) / (2 * sigma**2))


def pulls(images, source):
    """Flux of a source at many places over the error that white noise would give it."""
    matched = fftconvolve(images, source[None], mode="valid", axes=(1, 2))
    return (matched / np.sqrt((source**2).sum())).std()


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("sigma", [1.2, 2.5])
def test_errors_in_filtered_noise_are_right_and_in_raw_noise_not(name, sigma):
    kernel = KERNELS[name]
    found = NoiseCorrelation(correlation(kernel))
    images = noise(kernel, np.random.default_rng(1), 8)
    assert pulls(images, star(sigma)) == pytest.approx(found.error_factor(sigma), rel=0.05)
    seen = fftconvolve(star(sigma), found.filter)
    assert pulls(found.filtered(images), seen) == pytest.approx(1, abs=0.04)
    if name != "white":
        assert found.error_factor(sigma) > 1.15  # what treating it as white would miss


@pytest.mark.parametrize("name", KERNELS)
def test_the_variance_left_is_as_stated(name):
    found = NoiseCorrelation(correlation(KERNELS[name]))
    r = found.radius_px
    inside = found.filtered(noise(KERNELS[name], np.random.default_rng(2), 4))[
        :, r : N - r, r : N - r
    ]
    assert inside.var() == pytest.approx(found.variance, rel=0.03)


@pytest.mark.parametrize("name", KERNELS)
def test_three_ways_to_say_it_agree(name):
    exact = NoiseCorrelation(correlation(KERNELS[name]))
    images = noise(KERNELS[name], np.random.default_rng(3), 6)
    power = np.abs(np.fft.fft2(KERNELS[name], (64, 64))) ** 2
    for other in (
        NoiseCorrelation.from_power_spectrum(power),
        NoiseCorrelation.from_realisations(images),
        NoiseCorrelation.estimate(images[0], np.ones((N, N))),
    ):
        assert other.error_factor(2.0) == pytest.approx(exact.error_factor(2.0), rel=0.08)


def test_sources_and_masks_are_left_out_of_an_estimate():
    rng = np.random.default_rng(4)
    image, weights = noise(KERNELS["drizzle"], rng)[0], np.full((N, N), 4.0)
    image /= 2  # noise of the standard deviation that the weights state
    for y, x in rng.uniform(10, N - 20, (12, 2)).astype(int):
        image[y : y + 11, x : x + 11] += 20 * star(1.0)
    weights[100:105] = 0
    image[100:105] = 1e6
    found = NoiseCorrelation.estimate(image, weights)
    exact = NoiseCorrelation(correlation(KERNELS["drizzle"]))
    assert found.error_factor(2.0) == pytest.approx(exact.error_factor(2.0), rel=0.1)


def test_pixels_near_masks_and_edges_are_not_reached():
    found = NoiseCorrelation(correlation(KERNELS["drizzle"]))
    r = found.radius_px
    weights = np.ones((2, 30, 31))
    weights[1, 15, 12] = 0
    good = found.valid_after_filter(weights)
    assert good[0].sum() == (30 - 2 * r) * (31 - 2 * r)
    assert not good[1, 15 - r : 16 + r, 12 - r : 13 + r].any()
    assert good[1].sum() == good[0].sum() - (2 * r + 1) ** 2


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.ones((4, 5)), "shape"),
        (np.zeros((3, 3)), "middle"),
        (np.array([[0, 2, 0], [1, 1, 1], [0, 2, 0]]), "middle"),
        (np.array([[0, 0.5, 0], [0, 1, 0], [0, 0.1, 0]]), "mirror"),
        (np.full((3, 3), np.nan), "middle"),
    ],
)
def test_what_is_no_autocorrelation_is_refused(array, words):
    with pytest.raises(ValueError, match=words):
        NoiseCorrelation(array)


def test_too_little_sky_is_refused():
    with pytest.raises(ValueError, match="1000 are needed"):
        NoiseCorrelation.estimate(np.zeros((20, 20)), np.ones((20, 20)))


def seen_through(spacing, noise, rng):
    """A star with correlated noise of known correlation, on 80 x 80 pixels."""
    grid, psf = Grid.flat((80, 80), 0.2), PSF.gaussian(1.4, spacing=spacing, n_pixels=61)
    fine = Resampler(grid, PSF.gaussian(0.8), grid, psf, dtype=np.float64)
    point = np.zeros((1, 80, 80))
    point[0] = PSF.gaussian(0.8, n_pixels=(81, 81)).images[0][:80, :80]
    return fine(500 * point) + noise[:, :80, :80], psf, grid


@pytest.mark.parametrize("spacing", [1.0, 0.5])
def test_the_white_observation_is_the_same_light_with_white_noise(spacing):
    correlated = NoiseCorrelation(correlation(KERNELS["drizzle"]))
    images = noise(KERNELS["drizzle"], np.random.default_rng(5), 1)
    clean, psf, grid = seen_through(spacing, 0 * images, None)
    o = Observation(clean + images[:, :80, :80], psf, grid, weights=1.0, noise=correlated)
    white = o.whitened
    model = Resampler(grid, PSF.gaussian(0.8), grid, white.psf, dtype=np.float64)
    point = np.zeros((1, 80, 80))
    point[0] = PSF.gaussian(0.8, n_pixels=(81, 81)).images[0][:80, :80]
    inside = white.weights > 0
    seen = Observation(clean, psf, grid, weights=1.0, noise=correlated).whitened.data
    assert np.abs((model(500 * point) - seen)[inside]).max() < 1e-6 * seen.max()
    chi2 = o.chi2_map(o.data - clean)
    assert np.nanmean(chi2) == pytest.approx(1, abs=0.06)
    assert np.isnan(chi2[0, 0]).all()
    assert Observation(clean, psf, grid, weights=1.0).whitened.noise is None


def test_noise_of_an_observation_is_checked():
    grid, psf = Grid.flat((20, 20), 0.2), PSF.gaussian(1.4)
    data = np.zeros((2, 20, 20))
    with pytest.raises(ValueError, match="noise has 3 correlations, data have 2"):
        Observation(data, psf, grid, weights=1.0, noise=[None] * 3)
    with pytest.raises(ValueError, match="'guess'"):
        Observation(data, psf, grid, weights=1.0, noise="guess")
    with pytest.raises(ValueError, match="channel channel0: noise correlation: .* needed"):
        Observation(data, psf, grid, weights=1.0, noise="estimate")
    with pytest.raises(ValueError, match="is 0.7 px"):
        odd = PSF.gaussian(1.4, spacing=0.7)
        wide = NoiseCorrelation(correlation(KERNELS["drizzle"]))
        _ = Observation(data, odd, grid, weights=1.0, noise=wide).whitened


def test_an_estimate_is_reported():
    images = noise(KERNELS["drizzle"], np.random.default_rng(6))
    o = Observation(images, PSF.gaussian(1.4), Grid.flat((N, N), 0.2), noise="estimate")
    assert any("estimated from blank sky" in m and "2." in m for m in o.messages)
