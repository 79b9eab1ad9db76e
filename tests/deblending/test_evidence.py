"""Strengths learned from evidence: its numbers by their definitions, and what they do to a fit."""

import numpy as np
import pytest
from helpers.learned import Source

from clresample.deblending.solver.multiscale.evidence import (
    STEP,
    WIDE,
    LocalPowerSpectra,
    SourceEvidence,
    blurred_light,
)
from clresample.deblending.solver.multiscale.prior import MultiscalePrior, gaussian

PRIOR = MultiscalePrior()
SPECTRUM = np.array([30.0, 10.0])


def disk(n=41, size=5.0):
    """A round profile, max = 1."""
    y, x = np.indices((n, n)) - n // 2
    return np.exp(-np.hypot(y, x) / size)


def answers(sigmas=(1.0, 2.0), shape=(80, 90), pixel=(40, 45)):
    """Image of one pixel after blurs of these sigmas [px], and their transposes."""
    out = []
    for sigma in sigmas:
        y = gaussian(np.sqrt(2) * sigma, 30, unit_sum=True)
        image = np.zeros(shape)
        image[pixel[0] - 30 : pixel[0] + 31, pixel[1] - 30 : pixel[1] + 31] = np.outer(y, y)
        out.append(image)
    return np.array(out), np.array([pixel] * len(sigmas))


@pytest.fixture(scope="module")
def evidence():
    spectra = LocalPowerSpectra(PRIOR)
    return SourceEvidence(spectra, PRIOR, disk(), spectra.from_impulse_responses(*answers()))


def test_responses_are_transfer_functions(evidence):
    """Squared: exp(-4 pi^2 sigma^2 nu^2) of a Gaussian blur."""
    found = evidence.response.reshape(2, 64, 33)
    nu = np.fft.fftfreq(64)
    for sigma, power in zip((1.0, 2.0), found, strict=True):
        wanted = np.exp(-4 * np.pi**2 * sigma**2 * nu**2)
        np.testing.assert_allclose(power, np.outer(wanted, wanted[:33]), atol=1e-4)
    assert evidence.spectra.weight.sum() == pytest.approx(1)
    assert evidence.spectra.k @ evidence.spectra.weight == pytest.approx(1)


def test_determined_parameters_are_their_definition(evidence):
    """Pixel by pixel and frequency by frequency."""
    strengths = np.array([0.01, 0.1, 0.05])
    t, k, weight = evidence.sharpness(SPECTRUM), evidence.spectra.k, evidence.spectra.weight
    w = np.square(strengths)[:, None] * k * t
    wanted = np.zeros(3)
    for b in disk().ravel():
        wanted += (b * w / (1 + b * w.sum(0))) @ weight
    assert evidence.determined(strengths, SPECTRUM) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("strength", [0.01, 0.03, 0.3])
@pytest.mark.parametrize("scale", [0, 1])
def test_first_strengths_are_those_that_slopes_were_drawn_with(scale, strength):
    """Slopes H z + noise of covariance H, of structure at one scale, that all pixels show.

    The mean power of many, as a source of this size has few independent coefficients of 4 px.
    """
    prior = MultiscalePrior(scales_px=(1.0, 4.0), strengths=(0.1, 0.1), hyperprior_weight=1e-3)
    spectra, profile, rng = LocalPowerSpectra(prior), disk(40, 12.0), np.random.default_rng(7)
    root, flux = prior.amplitude(profile).ravel(), 3000.0
    u = [root[:, None] * np.kron(*axes) for axes in Source(profile, prior).axes]
    z, noise = rng.normal(size=(100, u[scale].shape[1])), rng.normal(size=(100, profile.size))
    residuals = flux * strength * z @ u[scale].T + noise
    powers = np.array([np.square(flux * residuals @ part).sum() / 100 for part in u])
    source = SourceEvidence(spectra, prior, profile, np.ones((1, spectra.weight.size)))
    found = source.first_strengths(powers, [flux])
    assert found[scale] == pytest.approx(strength, rel=0.15)
    assert found[1 - scale] < 0.5 * strength


def test_sources_that_determine_little_begin_with_the_priors_strengths(evidence):
    powers = np.full(3, 1e6)
    np.testing.assert_array_equal(evidence.first_strengths(powers, [0.1, 0]), PRIOR.strengths)
    lost = np.array([np.inf, 1.0, np.nan])  # slopes that overflow
    np.testing.assert_array_equal(evidence.first_strengths(lost, [1e6, 0]), PRIOR.strengths)


def test_determined_parameters_count_those_of_the_posterior():
    """trace(H (H + alpha^-2)^-1) of one scale on a flat profile, seen in every pixel."""
    prior = MultiscalePrior(scales_px=(1.0,), strengths=(0.1,))
    spectra, profile = LocalPowerSpectra(prior), np.ones((24, 24))
    source = Source(profile, prior)
    ky, kx = source.axes[0]
    whole = np.kron(ky, kx)
    curvature = 30.0**2 * whole.T @ whole
    for alpha in (0.01, 0.1):
        wanted = np.trace(np.linalg.solve(curvature + np.eye(len(curvature)) / alpha**2, curvature))
        image = np.zeros((1, 70, 70))
        image[0, 35, 35] = 1
        found = SourceEvidence(
            spectra, prior, profile, spectra.from_impulse_responses(image, [(35, 35)])
        )
        assert found.determined(np.array([alpha]), [30.0])[0] == pytest.approx(wanted, rel=0.1)


def test_strengths_are_found_from_draws():
    """Of structure that all is seen of, drawn from a strength: found from any start."""
    prior = MultiscalePrior(scales_px=(1.0,), strengths=(0.1,), hyperprior_weight=1e-3)
    spectra, rng = LocalPowerSpectra(prior), np.random.default_rng(0)
    image = np.zeros((1, 70, 70))
    image[0, 35, 35] = 1
    evidence = SourceEvidence(
        spectra, prior, np.ones((40, 40)), spectra.from_impulse_responses(image, [(35, 35)])
    )
    for truth in (0.03, 0.3):
        z = truth * rng.normal(size=(40, 40))
        alpha = np.array([0.1])
        for _ in range(20):
            gamma = evidence.determined(alpha, [1e4])[0]
            # of the posterior's mean: what is determined of the draw
            energy = (z**2).sum() * gamma / z.size
            alpha = evidence.learned(alpha, np.array([energy]), [1e4], 1.0)
        assert alpha[0] == pytest.approx(truth, rel=0.05)


def test_a_faint_source_keeps_its_start(evidence):
    faint = SPECTRUM / 1e4
    alpha = np.array(PRIOR.strengths)
    energies = alpha**2 * evidence.determined(alpha, faint) * 4
    assert evidence.learned(alpha, energies, faint, 1.0) == pytest.approx(alpha, rel=1e-2)


def test_misfit_is_not_taken_for_structure(evidence):
    alpha = np.array(PRIOR.strengths)
    given = alpha, np.full(3, 50.0), SPECTRUM * 100
    assert (evidence.learned(*given, 10.0) <= evidence.learned(*given, 1.0)).all()
    assert (evidence.learned(alpha, np.full(3, 1e6), SPECTRUM, 1.0) <= STEP * alpha * 1.0001).all()


def test_seen_grows_with_light(evidence):
    faint, bright = evidence.resolved_fraction(SPECTRUM), evidence.resolved_fraction(SPECTRUM * 100)
    assert (faint < bright).all() and (bright <= 1).all() and (faint > 0).all()
    assert (np.diff(bright) > -1e-9).all()  # coarser structure is seen better


def test_light_is_the_blurred_profile():
    profile = disk(21)
    k = gaussian(WIDE * 2.0, 18, unit_sum=True)
    whole = np.zeros((57, 57))
    whole[18:39, 18:39] = profile
    along = np.array([np.convolve(row, k, "same") for row in whole])
    both = np.array([np.convolve(column, k, "same") for column in along.T]).T[18:39, 18:39]
    np.testing.assert_allclose(blurred_light(profile, 2.0, 1), both, rtol=1e-10)
    np.testing.assert_allclose(blurred_light(profile, 2.0, 4), both[::4, ::4], rtol=1e-10)
