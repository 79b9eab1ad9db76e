"""Fits that are broken on purpose: how badly is told in sigma and in part of the flux."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.blends import blend, gaussian, observe, round_component

from clresample import Flag, Grid, Observation, PointSource, catalogue, deblend, fluxes, summary
from clresample.deblending.assessment.cores import star_variance
from clresample.deblending.assessment.misfit import chi2_excess, correlation_sum
from clresample.deblending.assessment.psf_width import width_errors
from clresample.deblending.assessment.status import (
    with_misfit_status,
    with_source_misfit_status,
)
from clresample.deblending.posterior.residuals import MISFIT_SIGMAS, _kernels, fine_scatter
from clresample.sky.observation import masked
from clresample.sky.psf import PSF

GRID = Grid.flat((80, 84), 0.1)
PLACES = (30, 28), (48, 55)


def broken(*, times=(1.0, 1.0), bright=300.0, noise=1.0, smooth=False, seed=0, extra=0.0):
    """Two galaxies of a peak of `bright` counts, whose models have `times` their flux.

    noise [counts]: of which the weights state 1; smooth: it is correlated; extra [counts]: light
    that no source has, far from both
    """
    rng, spectrum = np.random.default_rng(seed), (bright, bright)
    parts = [round_component(i, at, spectrum, n=25, sigma=2.5) for i, at in enumerate(PLACES)]
    grain = rng.normal(0, noise, (2, *GRID.shape))
    if smooth:  # correlated: the mean of a pixel and two neighbours, with the scatter kept
        grain = sum(np.roll(grain, k, axis=2) for k in range(3)) / np.sqrt(3)
    far = extra * gaussian(GRID.shape, (65, 20), 9 * np.eye(2))
    truth = blend(parts, grid=GRID, observations=(observe(GRID, ("g", "r")),))
    seen = observe(GRID, ("g", "r"), data=truth.model(0) + grain + far, weights=1.0)
    parts = [replace(c, spectrum=t * c.spectrum) for c, t in zip(parts, times, strict=True)]
    covariance = np.tile(np.eye(2) * 1e-4, (2, 1, 1))
    return blend(parts, grid=GRID, observations=(seen,), covariance=covariance)


def flagged(result):
    return (catalogue(result)["flags"] & Flag.MISFIT != 0).tolist()


def test_models_that_describe_the_data_are_neither_flagged_nor_renamed():
    for seed in range(20):
        found = with_misfit_status(broken(seed=seed))
        assert found.status == "converged" and summary(found)["good"] and not found.messages
        assert not any(flagged(found))


@pytest.mark.parametrize("bright", [20.0, 300.0, 30000.0])
def test_half_a_flux_is_wrong_however_bright(bright):
    found = with_misfit_status(broken(times=(0.5, 1), bright=bright))
    assert found.status == "misfit" and not found.converged
    assert flagged(found) == [True, False]
    ended, table = summary(found), catalogue(found)
    assert ended["misfits"] == [0] and not ended["good"] and ended["status"] == "misfit"
    assert table["misfit_fraction"][0] == pytest.approx(1, rel=0.3)  # as much is left as there is
    assert table["misfit_fraction"][1] < 0.01 and table["misfit_sigma"][0] > 5
    assert "chi2 per pixel" in found.messages[0] and "source 0 leaves" in found.messages[0]
    assert not any(catalogue(found)["flags"] & Flag.NOT_CONVERGED)


def test_a_faint_source_whose_chi2_is_all_but_of_noise_is_flagged():
    """Ten sigma are missing in 600 pixels."""
    found = with_misfit_status(broken(times=(0.5, 1), bright=5.0))
    assert flagged(found) == [True, False] and not summary(found)["good"]


def test_a_bright_galaxy_that_is_half_a_percent_off_is_no_misfit_of_a_fit_that_is_one():
    """Its flux is all but right, and chi2 is not that of noise."""
    found = with_misfit_status(broken(times=(1.005, 1), bright=3000.0))
    table = catalogue(found)
    assert table["misfit_sigma"][0] > 20
    assert table["misfit_fraction"][0] == pytest.approx(0.005, rel=0.3)
    assert found.status == "misfit" and not summary(found)["good"]
    assert not any(flagged(found)) and "leaves 0.5 % of its flux" in found.messages[0]


@pytest.mark.parametrize("times, status", [(1.0004, "converged"), (1.002, "misfit")])
def test_fits_converge_at_chi2_of_noise_alone(times, status):
    """chi2 of the galaxies' pixels is 1.0 and 1.5, though both leave 0.2 % of a flux at most."""
    found = with_misfit_status(broken(times=(times, 1), bright=3000.0))
    assert found.status == status and not found.misfit.sources().any()


def test_light_that_is_left_is_compared_with_the_light_beside_a_masked_core():
    """A model that is right but for a tenth of the light beside a core that holds most of it."""
    bright = broken(times=(1.1, 1), bright=3000.0)
    (seen,) = bright.observations
    core, (y, x) = np.zeros(seen.data.shape, bool), PLACES[0]
    core[:, y - 5 : y + 6, x - 5 : x + 6] = True
    without = replace(bright, observations=(masked(seen, core),))
    assert catalogue(without)["misfit_fraction"][0] == pytest.approx(0.1, rel=0.3)
    assert flagged(without) == [True, False]


def test_a_misfit_of_a_tenth_of_the_flux_is_flagged_where_it_is_no_noise():
    assert flagged(broken(times=(0.9, 1), bright=300.0)) == [True, False]
    assert flagged(broken(times=(0.9, 1), bright=3.0)) == [False, False]


@pytest.mark.parametrize(
    "given", [{"noise": 3.0}, {"noise": 1.3, "smooth": True}, {"smooth": True}]
)
def test_noise_that_weights_do_not_state_is_no_misfit(given):
    for seed in range(5):
        found = with_misfit_status(broken(seed=seed, **given))
        assert found.status == "converged" and not any(flagged(found))
        assert flagged(broken(times=(0.5, 1), seed=seed, **given)) == [True, False]


def test_noise_of_many_times_the_weights_is_no_good_fit():
    """Its errors are too small by as much."""
    for seed in range(5):
        found = with_misfit_status(broken(seed=seed, noise=10.0))
        assert found.status == "misfit" and not summary(found)["good"]
        (message,) = found.messages
        stated = float(message.partition("about the model by ")[2].split()[0])
        assert stated == pytest.approx(10, rel=0.1) and "scale weights" in message
        assert with_source_misfit_status(found) is found  # as a piece of a field too


def test_light_without_a_source_is_not_taken_for_noise():
    """It fills a good part of the sky; no source is to blame, so that all are flagged."""
    found = with_misfit_status(broken(extra=300.0))
    assert found.status == "misfit" and flagged(found) == [True, True]
    assert with_misfit_status(broken(extra=1.0)).status == "converged"


def test_other_ends_keep_their_status():
    result = replace(broken(times=(0.5, 1)), status="iteration limit")
    assert with_misfit_status(result) is result
    assert catalogue(result)["flags"][0] == Flag.NOT_CONVERGED | Flag.MISFIT


def test_what_is_known_of_a_model_is_not_kept_when_the_model_changes():
    result = broken()
    assert not result.misfit.sources().any()
    parts = tuple(replace(c, spectrum=c.spectrum / 2) for c in result.components)
    assert replace(result, components=parts).misfit.sources().all()


def test_excess_of_chi2_is_as_rare_as_its_sigma_says():
    rng = np.random.default_rng(1)
    for n in (10, 100, 3000):
        chi2 = 1.1 * rng.chisquare(n, 20000) / n
        found = chi2_excess(chi2, n)
        assert np.mean(found > 2) == pytest.approx(0.0228, abs=0.004)
        np.testing.assert_allclose([found.mean(), found.std()], [0, 1], atol=0.03)
    assert np.isnan(chi2_excess(np.nan, 0))


def test_correlated_noise_counts_for_fewer_pixels():
    rng, sky = np.random.default_rng(2), np.ones((200, 200), bool)
    white = rng.normal(size=(200, 202))
    pairs = (white[:, :-2] + white[:, 1:-1]) / np.sqrt(2)  # correlated by 1/2 along x
    assert correlation_sum(white[:, :200], sky) == pytest.approx(1, abs=0.01)
    assert correlation_sum(pairs, sky) == pytest.approx(1.5, abs=0.05)
    assert correlation_sum(pairs.T, sky) == pytest.approx(1.5, abs=0.05)
    assert correlation_sum(pairs, sky & (np.arange(200) < 1)) == 1  # too few to say


def test_scatter_about_neighbours_is_that_of_white_noise_and_not_of_light():
    used = np.ones((60, 60), bool)
    light = 1000 * gaussian((60, 60), (30, 30), 100 * np.eye(2))
    noise = np.random.default_rng(3).normal(0, 2.5, (60, 60))
    assert fine_scatter(noise, used) == pytest.approx(2.5, rel=0.06)
    assert fine_scatter(noise + light, used) == pytest.approx(2.5, rel=0.06)
    assert fine_scatter(noise, used & (np.arange(60) < 5)) == 1


@pytest.mark.parametrize("sigma_px, misfit", [(3.0, True), (0, False)])
@pytest.mark.parametrize("angle", [0, 25])
def test_a_galaxy_given_as_a_point_is_a_misfit_and_a_star_is_none(device, sigma_px, misfit, angle):
    """No pixel of its residual, filtered with the PSF, is significant."""
    objects = [((14.2, 17.1), (20, 14, 18), sigma_px)]
    images = scenes.observe(objects, noise=0.5, seed=4, angle=angle)
    point = PointSource(position_px=objects[0][0])
    found = deblend(images, [point], frame=scenes.frame(), device=device)
    assert found.converged and np.nanmax(found.misfit.residuals) < MISFIT_SIGMAS
    assert flagged(found) == [misfit]
    assert (found.misfit.wide_part[0] > 0.3) == misfit


@pytest.mark.parametrize("sigma_px, kind", [(3.0, "galaxy"), (0, "star")])
def test_errors_of_a_faint_point_hold_the_light_around_it(sigma_px, kind):
    """It is too faint for a misfit; its light is 20, 14 and 18."""
    objects = [((14.2, 17.1), (20, 14, 18), sigma_px)]
    images = scenes.observe(objects, noise=0.9, seed=4)
    found = deblend(images, [PointSource(position_px=objects[0][0])], frame=scenes.frame())
    (flux,), covariance = fluxes(found)
    error = np.sqrt(covariance[:, 0, 0])
    assert flagged(found) == [False]
    if kind == "star":
        np.testing.assert_allclose(error, [3.03, 3.63, 3.64], rtol=0.03)
    else:
        assert (np.abs(flux - (20, 14, 18)) < 2 * error).all() and (error > 2 * flux).all()


def beside_stars(off, places, *, extra=0.0):
    """A fit of stars whose PSF is wider by the factor `off`, and of light that no source has."""
    seen = PSF.gaussian(3.0 * off).images[0]
    half, data = seen.shape[0] // 2, np.random.default_rng(0).normal(0, 1, (1, *GRID.shape))
    for y, x in places:
        data[0, y - half : y + half + 1, x - half : x + half + 1] += 3e5 * seen
    data[0] += extra * gaussian(GRID.shape, (65, 20), 9 * np.eye(2))
    stars = [PointSource(position_px=place) for place in places]
    return deblend([Observation(data, PSF.gaussian(3.0), GRID, weights=1.0)], stars)


@pytest.mark.parametrize(
    "off, extra, status", [(1.02, 0, "converged"), (1.2, 0, "misfit"), (1.02, 20, "misfit")]
)
def test_the_error_of_a_stars_psf_is_no_misfit_and_hides_none(off, extra, status):
    """PSFs passed too narrow, by less than psf_error and by much more; a galaxy not listed."""
    found = beside_stars(off, [(40, 42)], extra=extra)
    assert found.status == status
    assert replace(found, psf_error=0.0).misfit.is_wrong


def test_variances_of_stars_add_up_about_their_fitted_places():
    result = beside_stars(1.0, [(40, 42), (40, 50)])
    one, other = (
        replace(
            result, components=(result.components[k],), rendered=(result.rendered[0][k : k + 1],)
        )
        for k in (0, 1)
    )
    both = star_variance(result, 0)
    np.testing.assert_allclose(both, star_variance(one, 0) + star_variance(other, 0), rtol=1e-6)
    elsewhere = tuple(replace(s, position_px=(30, 30)) for s in result.sources)
    np.testing.assert_array_equal(star_variance(replace(result, sources=elsewhere), 0), both)
    left, right = star_variance(one, 0)[0, 40, [39, 45]]
    assert left == pytest.approx(right, rel=1e-4)


@pytest.mark.filterwarnings("error")
def test_a_sharp_oversampled_psf_gives_a_kernel_without_a_warning():
    """As wide as the PSF on the observation's pixels, on which such a PSF could not be given."""
    (kernel,) = _kernels(PSF.gaussian(0.6, spacing=0.25))
    assert kernel.sum() == pytest.approx(1)
    variance = (kernel.sum(axis=0) * (np.arange(41) - 20) ** 2).sum()
    assert np.sqrt(variance) == pytest.approx(0.66, abs=0.1)  # with the pixel


@pytest.mark.parametrize("left, part", [(4.9, 0), (7.5, 0.5), (40.0, 1)])
def test_fluxes_are_uncertain_by_the_psf_s_width_where_light_is_left(left, part):
    """Of two Gaussians, whose flux changes by the ratio of the PSF's variance to their own."""
    result = replace(broken(), psf_error=0.03)
    residuals = np.array([[0.0, left], [0.0, 0.0]])
    known = replace(result.misfit, residuals=residuals, excess=np.zeros((2, 2)))
    vars(result)["misfit"] = known  # a cached property
    found = width_errors(result)
    light = [c.spectrum * c.morphology.sum() for c in result.components]
    variance = (result.observations[0].psf.fwhm_px / np.sqrt(8 * np.log(2))) ** 2
    wanted = 0.03 * part * light[0] * variance / 2.5**2
    np.testing.assert_allclose(found, [wanted, np.zeros(2)], rtol=0.05)
