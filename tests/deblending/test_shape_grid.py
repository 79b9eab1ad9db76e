"""Faint galaxies of uncertain size and wings: gains of profiles, one to be set, flux errors."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import MODEL_PSF, frame

from clresample import ExtendedSource, Grid, Observation, Settings, deblend
from clresample.deblending.profiles import profile, psf_second_moment
from clresample.deblending.start import alternatives, profile_fit, shape_grid
from clresample.deblending.start.population import LEARNED, PopulationPrior
from clresample.deblending.start.shape_grid import (
    FAR_STEPS,
    LN_BETA,
    SIZE_STEPS,
    UNUSUAL_IN_FLUXES,
    ShapeGrid,
)
from clresample.measurement.photometry import fluxes

SHAPE, SIDE_PX = (64, 64), 160
PLACES = (31.3, 32.1), (14.0, 40.0)


def galaxy(size_px, beta, snr, place=PLACES[0], shape=SHAPE):
    """Image of a galaxy of this signal to noise, for noise of 1."""
    theta = np.array([np.log(size_px), 0.1, 0.0, np.log(beta)])
    image = profile(theta, place, shape, psf_second_moment(MODEL_PSF), slopes=False)[0]
    return image * snr / np.linalg.norm(image)


@pytest.fixture
def fitted(device, monkeypatch):
    """Deblends an image with noise, one observation or more of a band; the ProfileFit, Result."""

    def fit_of(image, places=PLACES[:1], *, n=1, looked=shape_grid.fit_faint_shapes, **settings):
        fits, rng = [], np.random.default_rng(3)

        def noted(fit, scenes):
            fits.append(fit)
            looked(fit, scenes)

        monkeypatch.setattr(profile_fit, "fit_faint_shapes", noted)
        noise = np.sqrt(n) * rng.normal(size=(n, *image.shape))
        pixels = Grid.flat(image.shape, 0.1)
        observations = [
            Observation(image + one, MODEL_PSF, pixels, weights=1 / n, channels=[f"r{i}"],
                        bands=["r"], zero_points=25.0)
            for i, one in enumerate(noise)
        ]  # fmt: skip
        sources = [ExtendedSource(position_px=place) for place in places]
        options = {"frame": frame(image.shape), "device": device}
        return fits, deblend(observations, sources, settings=Settings(**settings), **options)

    return fit_of


@pytest.mark.parametrize("n, fit_sky", [(1, False), (1, True), (3, False), (3, True)])
def test_gains_are_differences_of_chi2(fitted, monkeypatch, n, fit_sky):
    """With a sky level and with exposures of a band; fluxes are of the light in the frame."""
    for module in (alternatives, profile_fit):
        monkeypatch.setattr(module, "MODEL_ERROR", 0.0)  # weights that stay as the sky changes
    image, compared = galaxy(2.5, 2.0, 16) + fit_sky * 0.05, []

    def looked(fit, scenes):
        grid = shape_grid._grids(fit, [0])[0]
        for theta in grid.theta[:: len(grid.theta) // 6]:
            fit._look(scenes, theta[None, None], slopes=False)
            fit.looking.solve(0.0)
            chi2 = fit.looking.compute_residuals(0.0)[0]
            inside = shape_grid.part_inside(fit.looking.components, theta[None])
            compared.append((chi2, *fit.looking.spectra[0] * inside))
        compared.append(grid)

    fitted(image, n=n, looked=looked, fit_sky=fit_sky)
    found, grid = np.array(compared[:-1]), compared[-1]
    some = slice(None, None, len(grid.theta) // 6)
    gain = grid.gain[some] - grid.gain[0]
    assert np.ptp(gain) > 10
    np.testing.assert_allclose(found[0, 0] - found[:, 0], gain, atol=0.1)
    np.testing.assert_allclose(found[:, 1:], grid.flux[some], rtol=5e-3)


def test_neighbours_stay_as_they_are(fitted):
    """The gain of a profile is of the data without the other source, in the order of the list."""
    image, kept = galaxy(2.5, 20.0, 20) + galaxy(1.5, 20.0, 60, PLACES[1]), []

    def looked(fit, scenes):
        kept.append(shape_grid._grids(fit, [1, 0][-len(fit.counts) :]))

    fitted(image, PLACES[::-1], looked=looked)
    fitted(galaxy(2.5, 20.0, 20), looked=looked)
    both, alone = kept[0], kept[1][0]
    assert list(both) == [1, 0] and [both[i].index for i in both] == [1, 0]
    np.testing.assert_allclose(both[1].gain.max(), alone.gain.max(), rtol=0.03)
    np.testing.assert_allclose(both[1].flux[0], alone.flux[0], rtol=0.03)


@pytest.mark.parametrize("beta, wide", [(0.5, True), (25.0, False)])
def test_wings_are_found_where_the_data_have_them(fitted, beta, wide):
    """At signal to noise 14, where steps from no wings end at none."""
    (fit,), _ = fitted(galaxy(2.5, beta, 14))
    assert (np.exp(fit.theta[0, 0, 3]) < 1.5) == wide


def test_a_large_galaxy_without_light_in_a_small_profile_is_found(fitted):
    """Ten times the expected size, at signal to noise 14."""
    middle = (SIDE_PX / 2, SIDE_PX / 2)
    image = galaxy(25.0, 20.0, 14, middle, (SIDE_PX, SIDE_PX))
    (fit,), result = fitted(image, [middle], fit_shifts=False)
    assert np.exp(fit.theta[0, 0, 0]) > 15
    error = np.sqrt(result.errors.flux[0, 0, 0])
    flux = sum(c.flux[0] for c in result.components)
    assert abs(flux - image.sum()) < 2 * error < image.sum()


def test_fluxes_and_errors_hold_the_estimate_beside_the_curvature(fitted):
    """In fluxes, colours and draws."""
    image = galaxy(2.5, 0.8, 12)
    (fit,), result = fitted(image)

    def unscattered(fit, scenes):
        shape_grid.fit_faint_shapes(fit, scenes)
        fit.flux_estimate[:] = 0

    _, without = fitted(image, looked=unscattered)
    change, scatter, noise = fit.flux_estimate[0, :, 0]
    assert scatter > 0.15 * result.components[0].flux[0] and noise > 0
    variance, curvature = result.errors.flux[0, 0, 0], without.errors.flux[0, 0, 0]
    assert variance == pytest.approx(scatter**2 + noise**2 + curvature, rel=1e-3)
    assert result.errors.colour[0, 0, 0] == pytest.approx(variance)
    changes = result.draws.flux_changes
    assert not changes.source.any() and (np.diff(changes.change) == 1).all()
    np.testing.assert_allclose(changes.by[-2:, 0], [scatter, noise], rtol=1e-3)
    moved = fluxes(result)[0] - fluxes(without)[0]
    assert moved[0, 0] == pytest.approx(change, rel=1e-3) and change > 0.03 * scatter


def test_noise_of_larger_profiles_is_one_error_of_a_band(fitted):
    """Exposures of a band have one spectrum, and so one error of it."""
    _, result = fitted(galaxy(2.5, 0.8, 12), n=2)
    colour = result.errors.colour[0]
    np.testing.assert_allclose(colour, colour[0, 0], rtol=1e-3)
    np.testing.assert_allclose(*result.sample_fluxes(3, 0)[:, 0].T, rtol=1e-6)


def test_a_galaxy_without_significant_light_stays_and_its_error_holds_the_scatter(fitted):
    """At signal to noise 3; one is significant from 5."""
    before = []

    def looked(fit, scenes):
        before.append(fit.theta.copy())
        shape_grid.fit_faint_shapes(fit, scenes)

    (fit,), _ = fitted(galaxy(2.5, 25.0, 3), looked=looked)
    np.testing.assert_array_equal(fit.theta, before[0])
    assert fit.flux_estimate[0, 1, 0] > 1


def test_fluxes_and_errors_hold_larger_profiles_of_a_galaxy_without_significant_light(fitted):
    """Ten times the expected size, at signal to noise 4.5: none is significant."""
    middle = (SIDE_PX / 2, SIDE_PX / 2)
    image = galaxy(25.0, 20.0, 4.5, middle, (SIDE_PX, SIDE_PX))
    (fit,), result = fitted(image, [middle], fit_shifts=False)
    assert np.exp(fit.theta[0, 0, 0]) < 5
    flux, variance = (float(found.squeeze()) for found in fluxes(result))
    assert fit.flux_estimate[0, 1, 0] > 0.2 * image.sum()
    assert fit.flux_estimate[0, 2, 0] > 0.2 * image.sum()
    assert (
        abs(flux - image.sum()) < np.sqrt(variance)
        and fit.flux_estimate[0, 0, 0] > 0.4 * image.sum()
    )


@pytest.fixture
def grid():
    """Makes a ShapeGrid with these gains (size, wings), and a fit for it with usual galaxies."""

    def made(gain, contamination=1.0, far=()):
        theta = shape_grid._alternatives(np.array([0.0, 0.1, -0.2, 1.9]), far=len(far) > 0)
        shape = SimpleNamespace(mean=np.array([0, 0, 0, 1.9]), scatter=np.array([0.4, 1, 1, 0.7]))
        prior = PopulationPrior([shape], [0], [0], 1, 1, 4)
        prior.contamination[0, 0] = contamination
        flux = np.exp(theta[:, :1] - theta[:, 3:])
        near = np.broadcast_to(gain, (len(SIZE_STEPS), len(LN_BETA))).ravel()
        gains = np.concatenate([[50.0], near, far])
        return ShapeGrid(0, 0, theta, gains, flux, flux**2 + 3), SimpleNamespace(population=prior)

    return made


def test_a_usual_galaxy_stays_and_its_error_holds_the_distance(grid):
    """Weights are prior and gain over contamination; only so far does the mean count."""
    gain = 50 - np.abs(np.arange(len(SIZE_STEPS)) - 2)[:, None] * np.array([1, 1, 9, 9])
    found, fit = grid(gain, 2.0)
    theta, (change, scatter, noise) = found.posterior(fit)
    np.testing.assert_array_equal(theta, found.theta[0])
    away = (found.theta[1:][:, LEARNED] - [0, 1.9]) / [0.4, 0.7]
    prior = np.exp(-(away**2).sum(1) / 2) / (2 * np.pi * 0.28)
    fraction = UNUSUAL_IN_FLUXES
    weight = np.exp(gain.ravel() / 4) * ((1 - fraction) * prior + fraction / 12)
    mean, square = (np.average(found.flux[1:] ** k, axis=0, weights=weight) for k in (1, 2))
    np.testing.assert_allclose(change, (mean - found.flux[0]) / 2)
    np.testing.assert_allclose(scatter**2, square - mean**2 + change**2)
    np.testing.assert_allclose(noise**2, square - found.flux[0] ** 2)


def test_an_unusual_galaxy_gets_the_mean(grid):
    """Two profiles with wings that fit as well: between them, and half of their distance."""
    gain = np.full((len(SIZE_STEPS), len(LN_BETA)), 10.0)
    gain[4, 3] = gain[6, 3] = 60
    found, fit = grid(gain)
    theta, (change, scatter, noise) = found.posterior(fit)
    np.testing.assert_allclose(theta, [0.9, 0.1, -0.2, LN_BETA[3]], atol=1e-3)
    one, other = found.flux[[1 + 4 * 4 + 3, 1 + 6 * 4 + 3]]
    assert abs(change[0]) < 1e-3 * one[0]
    np.testing.assert_allclose(scatter, (other - one) / 2, rtol=1e-3)
    assert noise[0] < 0.05 * scatter[0]  # that of the same two profiles is in the fit's


def test_without_significant_light_errors_hold_the_distance_to_larger_profiles(grid):
    """The present profile stays, though unusual ones fit better; each far one counts as eight."""
    gain = np.full((len(SIZE_STEPS), len(LN_BETA)), -90.0)
    gain[6, 3] = 20
    found, fit = grid(gain, far=np.full(len(FAR_STEPS), 20.0))
    found.gain[0] = 1
    theta, (change, scatter, _) = found.posterior(fit)
    np.testing.assert_array_equal(theta, found.theta[0])
    far = found.flux[[7 * 4, *range(29, 33)]], [1, 8, 8, 8, 8]
    mean, square = (np.average(far[0] ** k, axis=0, weights=far[1]) for k in (1, 2))
    np.testing.assert_allclose(found.flux[0] + change, mean, rtol=1e-3)
    np.testing.assert_allclose(scatter, np.sqrt(square - mean**2), rtol=1e-3)


@pytest.mark.parametrize(
    "present, gain, contamination, found",
    [(50, 53, 1, True), (50, 52.5, 1, False), (50, 60, 2.5, False), (50, 63, 2.5, True),
     (0, 24, 1, False), (0, 26, 1, True)],
)  # fmt: skip
def test_fits_again_are_from_significant_profiles(grid, present, gain, contamination, found):
    """Better by 1 with the prior, 1.8 contamination here, and by 25 contamination than no light.
    The flux stays where such a profile is left, or the present one has no light."""
    gains = np.zeros((len(SIZE_STEPS), len(LN_BETA)))
    gains[4, 0] = gain
    alternatives, fit = grid(gains, contamination)
    alternatives.gain[0] = present
    assert alternatives.best(fit) == (1 + 4 * len(LN_BETA)) * found
    _, (change, scatter, _) = alternatives.posterior(fit)
    assert (change[0] == 0) == (found or not present) and scatter[0] > 0


@pytest.mark.parametrize("snr, n_far", [(14, 0), (6, 4), (0, 4)])
def test_larger_sizes_are_compared_with_little_light(fitted, snr, n_far):
    """Up to 37 times the present size, beside the 28 profiles near it and the present one."""
    kept = []

    def looked(fit, scenes):
        kept.append((fit.theta[0, 0, 0], shape_grid._grids(fit, [0])[0].theta))

    fitted(galaxy(2.5, 6.5, snr), looked=looked)
    (present, theta), near = kept[0], 1 + len(SIZE_STEPS) * len(LN_BETA)
    steps = shape_grid.FAR_STEPS[:n_far]
    np.testing.assert_allclose(theta[near:, 0] - present, steps)
    assert len(theta) == near + n_far and len(SIZE_STEPS) * len(LN_BETA) == 28
