"""Several exposures of a band: one spectrum value for all of them, by the ratio of zero points."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from clresample import (
    PSF,
    Blend,
    ExtendedSource,
    Grid,
    Observation,
    PaperSettings,
    Settings,
    SingleScalePrior,
    catalogue,
    deblend,
    deblend_many,
)
from clresample.deblending.fit import Fit, render_fits, start_fits
from clresample.deblending.iterate import iterate
from clresample.deblending.linear.aligned_observation import align_observations
from clresample.deblending.posterior.posterior import Posterior, posterior_of
from clresample.deblending.refit.colour_gradient import run_gradient_tests
from clresample.device.device import get_device
from clresample.files.results import read_result, write_result
from clresample.measurement.photometry import fluxes
from clresample.measurement.quality import channel_chi2

SHAPE, N, SIGMA, POINT = (48, 52), 4, 2.0, 25.0
PLACES = (22.0, 24.0), (29.0, 31.0), (12.0, 40.0)
GRID, NARROW = Grid.flat(SHAPE, 0.2), PSF.gaussian(1.5)
SOURCES = [ExtendedSource(position_px=PLACES[0], n_components=2)]
SOURCES += [ExtendedSource(position_px=p) for p in PLACES[1:]]
DEPTHS = (0.4, 1.6, 1.2, 0.8)  # weights over their mean


@pytest.fixture(scope="module")
def images():
    """Exposures of g (N, Ny, Nx) and an image of r, under less noise than is stated: no part of a
    fit then depends on chi2 being above 1."""
    rng, (y, x) = np.random.default_rng(5), np.indices(SHAPE)
    light = []
    for (y0, x0), size, flux in zip(PLACES, (2.2, 1.7, 1.5), (4000, 900, 300), strict=True):
        profile = np.exp(-np.sqrt((y - y0) ** 2 + (x - x0) ** 2) / size)
        light.append(gaussian_filter(flux * profile / profile.sum(), 1.5))
    noise = 0.6 * rng.normal(size=(N + 1, *SHAPE))
    g = sum(light) + SIGMA * noise[:N]
    return g, 0.7 * light[0] + 1.4 * light[1] + light[2] + noise[N]


def red(images):
    return Observation(images[1], NARROW, GRID, weights=1.0, channels=["r"], zero_points=POINT)


def exposures(data, scales=(1.0,) * N, depths=(1.0,) * N, **given):
    """Observations of one exposure each, in counts that are `scales` times as many."""
    return [
        Observation(
            image * scale,
            NARROW,
            GRID,
            weights=depth * (SIGMA * scale) ** -2,
            channels=[f"g{i}"],
            bands=["g"],
            name=f"G{i}",
            zero_points=POINT + 2.5 * np.log10(scale),
            **given,
        )
        for i, (image, scale, depth) in enumerate(zip(data, scales, depths, strict=True))
    ]


def stacked(data):
    return Observation(
        np.mean(data, axis=0),
        NARROW,
        GRID,
        weights=len(data) / SIGMA**2,
        channels=["g"],
        zero_points=POINT,
    )


def measured(result):
    """Fluxes and errors (S, 2) of the first and last channel."""
    flux, covariance = fluxes(result)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    return flux[:, [0, -1]], error[:, [0, -1]]


@pytest.fixture(scope="module")
def stack(images):
    settings = Settings(loss_tol=1e-2)
    return deblend([stacked(images[0]), red(images)], SOURCES, settings=settings, dtype=np.float64)


def test_n_exposures_give_what_one_image_of_n_times_the_weight_does(images, stack):
    """Of the same pixels, to the last digits: flux, errors, shapes, the iterations too."""
    copies = exposures([np.mean(images[0], axis=0)] * N, depths=DEPTHS)
    settings = Settings(loss_tol=1e-2)
    tied = deblend([*copies, red(images)], SOURCES, settings=settings, dtype=np.float64)
    (flux, error), (found, own) = measured(stack), measured(tied)
    assert len(tied.losses) == len(stack.losses)
    np.testing.assert_allclose((found - flux) / error, 0, atol=1e-4)
    np.testing.assert_allclose(own, error, rtol=1e-5)
    for one, other in zip(tied.components, stack.components, strict=True):
        np.testing.assert_allclose(one.morphology, other.morphology, atol=1e-5)
    np.testing.assert_allclose(tied.errors.moments, stack.errors.moments, rtol=1e-4)
    np.testing.assert_allclose(tied.covariance[0], stack.covariance[0], rtol=1e-5)
    assert [len(m) for m in tied.draws.modes] == [len(m) for m in stack.draws.modes]
    one, other = catalogue(tied, magnitudes=True), catalogue(stack, magnitudes=True)
    assert {"colour_g_r", "snr", "rms_size_err", "flux_err_g"} <= {*one.colnames} & {
        *other.colnames
    }
    of_each = {"name", "misfit_sigma", "misfit_fraction"}  # residuals are those of an exposure
    for name in {*one.colnames} & {*other.colnames} - of_each:
        values = (np.asarray(getattr(t[name], "value", t[name]), float) for t in (one, other))
        np.testing.assert_allclose(*values, rtol=1e-3, atol=1e-6, err_msg=name)
    spectra = np.array([c.spectrum[:N] for c in tied.sample(1, np.random.default_rng(1))[0]])
    np.testing.assert_allclose(spectra, spectra[:, :1] * np.ones(N), rtol=1e-9)


def test_evidence_for_a_gradient_is_that_of_the_stack(images):
    device, settings = get_device(None), Settings(loss_tol=1e-2)
    sources = tuple(ExtendedSource(position_px=p) for p in PLACES)
    copies = exposures([np.mean(images[0], axis=0)] * N, depths=DEPTHS)
    found = []
    for observations in ([*copies, red(images)], [stacked(images[0]), red(images)]):
        fit = Fit(Blend(tuple(observations), sources), settings, device, np.float64, pad=1)
        start_fits([fit])
        iterate([fit], fit.settings, device, np.float64)
        found.append(run_gradient_tests([fit])[0])
    assert len(found[0].components)
    np.testing.assert_array_equal(found[0].components, found[1].components)
    # [1], a logarithm: one of 20 counts as clear
    np.testing.assert_allclose(found[0].evidence, found[1].evidence, atol=0.1)


def test_exposures_with_noise_of_their_own_agree_with_their_stack(images, stack):
    """Weights of the start follow the data's own misfit, which N exposures have N times."""
    tied = deblend([*exposures(images[0]), red(images)], SOURCES, settings=Settings(loss_tol=1e-2))
    (flux, error), (found, own) = measured(stack), measured(tied)
    assert np.abs((found - flux) / error).max() < 0.15
    np.testing.assert_allclose(own, error, rtol=0.03)
    assert all(0.2 < chi2 < 0.6 for chi2 in channel_chi2(tied)[0].values())


@pytest.mark.parametrize("fit_sky", [False, True])
def test_zero_points_give_the_ratio_of_counts(images, fit_sky):
    scales, settings = (1.0, 3.0, 0.2, 40.0), Settings(fit_sky=fit_sky)
    one = deblend([*exposures(images[0]), red(images)], SOURCES, settings=settings)
    other = deblend([*exposures(images[0], scales), red(images)], SOURCES, settings=settings)
    flux, error = measured(one)
    np.testing.assert_allclose((measured(other)[0] - flux) / error, 0, atol=1e-3)
    counts = np.array([c.spectrum[:N] for c in other.components]) / scales
    np.testing.assert_allclose(counts, counts[:, :1] * np.ones(N), rtol=1e-6)
    table = catalogue(other)
    assert [n for n in table.colnames if n.startswith("flux_")] == [
        *("flux_g", "flux_err_g", "flux_r", "flux_err_r")
    ]
    assert {f"chi2_G{i}" for i in range(N)} | {f"max_residual_g{i}" for i in range(N)} <= {
        *table.colnames
    }
    np.testing.assert_allclose(table["flux_g"].value, catalogue(one)["flux_g"].value, rtol=1e-4)


def test_exposures_may_be_channels_of_one_observation(images):
    cube = Observation(
        images[0],
        NARROW,
        GRID,
        weights=SIGMA**-2,
        channels=[f"g{i}" for i in range(N)],
        bands=["g"] * N,
        zero_points=POINT,
    )
    one = deblend([cube, red(images)], SOURCES)
    other = deblend([*exposures(images[0]), red(images)], SOURCES)
    flux, error = measured(other)
    np.testing.assert_allclose((measured(one)[0] - flux) / error, 0, atol=4e-2)
    np.testing.assert_allclose(measured(one)[1], error, rtol=2e-2)


def test_errors_are_those_of_the_dense_matrix_summed_over_channels(images):
    """The factor's inverse against that of the untied matrix, its rows summed over the band."""
    observations = [*exposures(images[0], (1.0, 3.0, 0.2, 40.0)), red(images)]
    settings = Settings(fit_sky=True, fit_shifts=True, max_iter=60)
    result, posterior, free = _posteriors(observations, settings)
    n, k = len(result.components), posterior.layout.n_modes
    ends = np.cumsum([0, *free.layout.sizes])
    columns, ties = [], posterior.layout.ties
    for i in range(n):
        block = np.zeros((ends[-1], k[i] + ties.n_bands))
        block[ends[i] + np.arange(k[i]), np.arange(k[i])] = 1
        block[ends[i] + k[i] : ends[i + 1], k[i] :] = ties.matrix
        columns.append(block)
    common = np.zeros((ends[-1], ends[-1] - ends[-2]))
    common[ends[-2] :] = np.eye(ends[-1] - ends[-2])
    by_band = np.concatenate([*columns, common], axis=1)
    dense = free.matrix.dense()
    wanted = by_band.T @ dense @ by_band
    found = posterior.matrix.dense()
    scale = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        found / scale / scale[:, None], wanted / scale / scale[:, None], atol=1e-5
    )
    inverse = np.linalg.inv(wanted + 1e-9 * np.diag(np.diag(wanted)))
    start = np.cumsum([0, *posterior.layout.sizes])
    for i in range(n):
        at = slice(start[i], start[i + 1])
        np.testing.assert_allclose(
            np.sqrt(np.diag(posterior.covariance.block(i, i))),
            np.sqrt(np.diag(inverse[at, at])),
            rtol=1e-3,
        )


def _posteriors(observations, settings):
    """A Result, its Posterior, and that of the same scene with no ties."""
    device = get_device(None)
    fit = Fit(Blend(tuple(observations), tuple(SOURCES)), settings, device, np.float32, pad=1)
    start_fits([fit])
    iterate([fit], settings, device, np.float32)
    (seen,) = render_fits([fit])
    result = fit.result(seen)
    peaks = np.array([m.max() for m in fit.state.morph])
    tied, _ = posterior_of(fit, [c.morphology for c in result.components], peaks, seen)
    solution = replace(tied.solution, scene=replace(tied.solution.scene, ties=None))
    free = Posterior(solution, align_observations(fit), fit_sky=True, fit_shifts=True)
    return result, tied, free


def test_blends_with_and_without_an_exposure_are_fitted_side_by_side(images):
    both = [*exposures(images[0]), red(images)]
    blends = [Blend(tuple(o), tuple(SOURCES)) for o in (both, both[1:], both)]
    found = deblend_many(blends)
    assert [len(r.channels) for r in found] == [5, 4, 5]
    flux, error = measured(found[0])
    np.testing.assert_allclose((measured(found[2])[0] - flux) / error, 0, atol=1e-2)
    assert np.abs((measured(found[1])[0] - flux) / error).max() < 1


def test_an_exposure_without_weight_changes_nothing(images):
    dead = Observation(
        np.zeros(SHAPE), NARROW, GRID, weights=0.0, channels=["g9"], bands=["g"], zero_points=20.0
    )
    one = deblend([*exposures(images[0]), red(images)], SOURCES)
    other = deblend([*exposures(images[0]), dead, red(images)], SOURCES)
    flux, error = measured(one)
    np.testing.assert_allclose((measured(other)[0] - flux) / error, 0, atol=4e-2)
    np.testing.assert_allclose(measured(other)[1], error, rtol=2e-2)


@pytest.mark.parametrize("prior", [None, "one scale"])
def test_other_priors_keep_one_value_a_band(images, prior):
    settings = PaperSettings(prior=None if prior is None else SingleScalePrior(), max_iter=60)
    result = deblend([*exposures(images[0]), red(images)], SOURCES, settings=settings)
    spectra = np.array([c.spectrum[:N] for c in result.components])
    np.testing.assert_allclose(spectra, spectra[:, :1] * np.ones(N), rtol=1e-5)


def test_bands_are_kept_in_files(images, tmp_path):
    result = deblend([*exposures(images[0], saturation=500.0), red(images)], SOURCES)
    write_result(tmp_path / "r.fits", result)
    again = read_result(tmp_path / "r.fits")
    assert again.bands == {"g": 0, "r": N}
    assert [list(o.saturation or ()) for o in again.observations[:1]] == [[500.0]]
    assert catalogue(again).colnames == catalogue(result).colnames


@pytest.mark.parametrize("bands", [["g", "r"], [""], 3])
def test_bands_that_are_no_names_are_refused(bands):
    with pytest.raises((ValueError, TypeError)):
        Observation(np.ones(SHAPE), NARROW, GRID, weights=1.0, bands=bands)
