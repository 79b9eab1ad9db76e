"""Formulas of the evidence on profiles and answers made by hand, and the limits of strengths."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.solver.multiscale.evidence import (
    MIN_SEEN,
    MIN_SIGNIFICANCE,
    LocalPowerSpectra,
    SourceEvidence,
    _pixels_at,
)
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.response import _median, _middle, _unpadded


def test_values_are_shared_between_the_levels_about_them():
    levels = np.array([0.0, 1.0, 3.0])
    found = _pixels_at(np.array([0.25, 1.0, 2.0, 3.0, -5.0, 9.0]), levels)
    np.testing.assert_allclose(found, [0.75 + 1, 0.25 + 1 + 0.5, 0.5 + 1 + 1])
    values = np.random.default_rng(0).uniform(0, 3, 50)
    found = _pixels_at(values, levels)
    assert found.sum() == pytest.approx(50) and found @ levels == pytest.approx(values.sum())


PRIOR = MultiscalePrior(scales_px=(1.0, 3.0), strengths=(0.02, 0.1), hyperprior_weight=10.0)
SPECTRUM, OLD, ENERGIES = np.array([2.0]), np.array([0.05, 0.1]), np.array([0.3, 0.5])


def evidence(prior, *, level):
    """SourceEvidence of a round profile on 15 x 17 pixels, with one response at all frequencies."""
    spectra = LocalPowerSpectra(prior)
    y, x = np.indices((15, 17))
    profile = np.exp(-np.hypot(y - 7, x - 8) / 3)
    return SourceEvidence(spectra, prior, profile, np.full((1, len(spectra.weight)), level))


@pytest.fixture
def bright():
    return evidence(PRIOR, level=1e4)


@pytest.mark.parametrize("chi2", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("clear", [False, True])
def test_new_strengths_are_the_fixed_point_of_the_evidence(bright, chi2, clear):
    """Energies over determined numbers.

    Misfit makes energies smaller, never larger. Significant structure at the finest scale has a
    tenth of the prior's weight there, and ignores misfit.
    """
    resolved, gamma = bright.resolved_fraction(SPECTRUM), bright.determined(OLD, SPECTRUM)
    assert (resolved > 0.9).all() and (gamma > 5).all()
    m = np.array([1 if clear else 10, 10]) / resolved**2
    misfit = np.array([1 if clear else max(chi2, 1), max(chi2, 1)])
    wanted = np.sqrt((ENERGIES / misfit + m * np.square(PRIOR.strengths)) / (gamma + m))
    assert ((wanted > OLD / 4) & (wanted < 4 * OLD)).all()
    found = bright.learned(OLD, ENERGIES, SPECTRUM, chi2, clear=clear)
    np.testing.assert_allclose(found, wanted)
    if clear and chi2 > 1:
        assert found[0] > 1.2 * bright.learned(OLD, ENERGIES, SPECTRUM, chi2)[0]


@pytest.mark.parametrize(
    "strengths, old, energies, wanted",
    [
        ((0.02, 0.1), OLD, 1e9 * ENERGIES, 4 * OLD),
        ((0.02, 0.1), np.array([1e-3, 0.5]), np.array([1e9, 1e9]), [4e-3, 1.0]),
        ((1e-6, 1e-6), np.full(2, 2e-3), np.zeros(2), [1e-3, 1e-3]),
    ],
)
def test_new_strengths_are_limited(strengths, old, energies, wanted):
    """Within a factor of 4 of the old ones, and 0.1 % to 100 %."""
    prior = MultiscalePrior(scales_px=(1.0, 3.0), strengths=strengths, hyperprior_weight=10.0)
    found = evidence(prior, level=1e4).learned(old, energies, SPECTRUM, 1.0)
    np.testing.assert_allclose(found, wanted)


@pytest.mark.parametrize("excess, clear", [(0.01, True), (-0.01, False)])
def test_structure_is_significant_beyond_what_the_data_determine(bright, excess, clear):
    gamma = bright.determined(OLD, SPECTRUM)[0]
    assert gamma > 0.2 * MIN_SIGNIFICANCE  # else the test could not tell one from the other
    energies = np.array([(gamma + MIN_SIGNIFICANCE + excess) * OLD[0] ** 2, 0.0])
    assert bright.is_clear(OLD, energies, SPECTRUM) == clear
    assert not bright.is_clear(OLD, np.array([0.0, 1e9]), SPECTRUM)  # at the finest scale alone


def test_what_is_not_seen_stays_as_it_was_expected():
    prior = MultiscalePrior(scales_px=(1.0,), strengths=(0.02,), hyperprior_weight=10.0)
    dark = evidence(prior, level=0.0)
    assert dark.resolved_fraction(np.ones(1)).tolist() == [MIN_SEEN] and MIN_SEEN == 1e-3
    assert dark.determined(np.array([0.02]), np.ones(1)).tolist() == [0]
    found = dark.learned(np.array([0.02]), np.array([0.5]), np.ones(1), 1.0)
    np.testing.assert_allclose(found, 0.02, rtol=1e-3)
    assert dark.curvature(np.ones(1)).tolist() == [0]


def test_curvature_of_what_is_seen_alike_at_all_frequencies_is_that():
    """Weighted by P^1.5 over the mean of P^0.5: more than it where P is peaked."""
    prior = MultiscalePrior()
    one = evidence(prior, level=5.0)
    p, weight = one.spectra.broadened(prior.amplitude(np.ones((3, 3)))), one.spectra.weight
    np.testing.assert_allclose(p @ weight, 1, rtol=1e-12)
    p = one.spectra.broadened(
        np.sqrt(np.exp(-np.hypot(*(np.indices((15, 17)) - np.array([7, 8])[:, None, None])) / 3))
    )
    wanted = 4 * 5 * (p**1.5 @ weight) / (p**0.5 @ weight)
    np.testing.assert_allclose(one.curvature(np.array([2.0])), wanted, rtol=1e-10)


def test_power_is_broadened_by_the_light_that_it_lies_in():
    """Noise of a kernel's power times an amplitude has the convolution of both powers; mean 1."""
    prior = MultiscalePrior()
    amplitude = np.random.default_rng(3).uniform(0, 1, (9, 12))
    light = np.fft.fft2(np.abs(np.fft.fft2(amplitude, (64, 64))) ** 2)
    for found, taps in zip(
        LocalPowerSpectra(prior).broadened(amplitude), prior.kernels(), strict=True
    ):
        along = np.abs(np.fft.fft(taps, 64)) ** 2
        power = np.fft.ifft2(np.fft.fft2(np.outer(along, along)) * light).real
        wanted = (power / power.mean())[:, :33].ravel()
        np.testing.assert_allclose(found, wanted, atol=1e-9 * wanted.max())


def test_answers_are_taken_within_half_a_side_of_their_pixel():
    """Of 64: what lies further away is none of it, and nothing beyond the image is missed."""
    spectra = LocalPowerSpectra(MultiscalePrior(scales_px=(1.0,), strengths=(0.1,)))
    image = np.zeros((2, 90, 20))
    image[:, 40, 3] = 2.0
    image[0, 40 - 33], image[0, 40 + 32] = 7.0, 7.0
    found = spectra.from_impulse_responses(image, [(40, 3)] * 2)
    np.testing.assert_allclose(found, 2.0)
    np.testing.assert_allclose(spectra.from_impulse_responses(image[:1, 2:60], [(38, 3)]), 2.0)
    image[1, 40 + 31, 3] = image[1, 40 - 31, 3] = 0.5
    nu = np.fft.fftfreq(64)
    wanted = np.repeat(2 + np.cos(2 * np.pi * 31 * nu), 33)
    np.testing.assert_allclose(spectra.from_impulse_responses(image, [(40, 3)] * 2)[1], wanted)


def test_the_middle_of_what_was_seen():
    weights = np.zeros((2, 9, 12))
    weights[0, 2, 3], weights[1, 6, 9] = 1.0, 3.0
    assert _middle(weights).tolist() == [5, 8]  # 5, 7.5
    weights[0, 8, 11] = -5  # what rounding leaves below 0 does not count
    assert _middle(weights).tolist() == [5, 8] and _middle(0 * weights).tolist() == [0, 0]
    assert _median(np.array([[0.0, 1.0, 2.0, 9.0]])) == 2 and _median(np.zeros(3)) == 0
    part = _unpadded(SimpleNamespace(unpadded_shape=(5, 7)), np.zeros((3, 8, 9)))
    assert part.shape == (3, 5, 7)
