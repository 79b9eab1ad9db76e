"""Steps on the device as NumPy's AMSGrad, with a prior and without, on builds of CPUs and GPUs."""

import numpy as np
import pytest
from helpers.solver import (
    PRIOR,
    STEPS,
    changed,
    close,
    engine,
    every_type,
    posed,
    ragged,
    references,
    with_and_without,
)

from clresample.paper.solver import reference as ref
from clresample.paper.solver.amsgrad import StepSizes
from clresample.paper.solver.constraints import MaxNorm, ProxChain
from clresample.paper.solver.prior import SingleScalePrior


@every_type
@with_and_without
def test_steps_are_the_reference(build, prior, dtype):
    pairs = ragged(build, dtype)
    e, found = engine(pairs, build, dtype, prior=prior), references(pairs, prior)
    losses = e.run(4)
    for i, r in enumerate(found):
        for k in range(4):
            r.gradient()
            close(losses[k, i], r.loss, dtype)
            r.update()
    for r, now in zip(found, e.states(), strict=True):
        assert now.n_steps == 4
        # a step divides a gradient by its own size: where that is tiny, its rounding is a step's
        grain = 1 if dtype == np.float64 else 10
        for s in range(len(r.morph)):
            close(now.morph[s] / grain, r.morph[s] / grain, dtype)
        close(now.spectra, r.spectra, dtype)
        close(now.sky, r.sky, dtype)
    for r in found:
        r.gradient()
    close(e.final_losses(), [r.loss for r in found], dtype)


def test_a_fixed_morphology_stays(build):
    scene, state = posed(build, fixed=(0, 2))
    e = engine([(scene, state)], build)
    e.run(5)
    (now,) = e.states()
    for s in (0, 2):
        np.testing.assert_array_equal(now.morph[s], state.morph[s])
    assert not np.array_equal(now.morph[1], state.morph[1])
    e = engine([changed(scene, state, fixed=np.ones(3, bool))], build)
    e.run(5)
    (now,) = e.states()
    for a, b in zip(now.morph, state.morph, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(now.spectra, state.spectra)


def test_the_sky_of_a_channel_without_weight_stays(device):
    scene, state = posed(device, sky_precision=None)
    scene, state = changed(scene, state, weights=[scene.weights[0], 0 * scene.weights[1]])
    e = engine([(scene, state)], device)
    e.run(2)
    sky = e.states()[0].sky
    np.testing.assert_array_equal(sky[1:], state.sky[1:])
    assert np.isfinite(sky[0]) and sky[0] != state.sky[0]


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_sky_step_is_half_of_newtons(device, unit):
    """Alone with the data and what is expected it leaves half of the mean of both, however faint
    the weights."""
    known = unit * np.array([0.0, 700.0, 1e5])
    scene, state = posed(
        device, spectra=np.zeros((3, 3)), step_scale=np.zeros((3, 3)), sky_precision=known
    )
    scene, state = changed(scene, state, weights=[unit * w for w in scene.weights])
    e = engine([(scene, state)], device)
    e.run(1)
    pairs = list(zip(scene.weights, scene.data, strict=True))
    light = np.concatenate([(w * d).sum(axis=(1, 2)) for w, d in pairs])
    weight = known + np.concatenate([w.sum(axis=(1, 2)) for w, _ in pairs])
    close(e.states()[0].sky, (state.sky + light / weight) / 2, np.float64)


def test_a_normalisation_hands_its_factor_to_the_spectra(device):
    """Without a prior, max = 1 and the model stays."""
    pair = posed(device, step_scale=np.zeros((3, 3)), fit_sky=False)
    still = StepSizes(latent=STEPS.latent, morphology=0.0, spectrum=STEPS.spectrum)
    e = engine([pair], device, prior=None, chain=ProxChain(MaxNorm()), steps=still)
    first, second = e.run(2)[:, 0]
    (now,) = e.states()
    assert second == pytest.approx(first, rel=1e-12)
    for m in now.morph:
        assert m.max() == pytest.approx(1, rel=1e-12)


@every_type
@with_and_without
def test_a_warm_start_goes_on_as_if_nothing_had_happened(device, prior, dtype):
    pairs = ragged(device, dtype)
    whole = engine(pairs, device, dtype, prior=prior)
    whole.run(10)
    losses = whole.run(10)
    first = engine(pairs, device, dtype, prior=prior)
    first.run(10)
    scenes = [scene for scene, _ in pairs]
    second = engine(list(zip(scenes, first.states())), device, dtype, prior=prior)
    np.testing.assert_array_equal(second.run(10), losses)
    for a, b in zip(whole.states(), second.states(), strict=True):
        for m, n in zip(a.morph, b.morph, strict=True):
            np.testing.assert_array_equal(m, n)
        np.testing.assert_array_equal(a.spectra, b.spectra)
        np.testing.assert_array_equal(a.memory.spectra, b.memory.spectra)
        assert a.n_steps == b.n_steps == 20


def test_priors_have_unit_variance():
    """sum of K's squares is 1; its taps fall as a Gaussian."""
    taps = SingleScalePrior(correlation_px=2.0).taps
    assert len(taps) == 13 and (taps**2).sum() == pytest.approx(1)
    assert taps[8] / taps[6] == pytest.approx(np.exp(-0.5))
    assert len(SingleScalePrior(correlation_px=1.5).taps) == 11  # cut behind 3 sigma, not before
    assert np.array_equal(SingleScalePrior(correlation_px=1e-300).taps, [0, 1, 0])  # nor a warning
    noise = np.random.default_rng(0).normal(size=(200, 200))
    assert ref.blur(noise, taps)[10:-10, 10:-10].std() == pytest.approx(1, abs=0.05)
    assert PRIOR.amplitude(np.array([-1.0, 4.0])).tolist() == [0, 0.2]
