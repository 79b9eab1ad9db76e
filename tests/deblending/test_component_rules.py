"""Tests for a second component, and the gain that they require, on fits made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.told import named

from clresample.deblending.component_images import ComponentImages
from clresample.deblending.ended import Ended
from clresample.deblending.linear.rendered_models import RenderedModel, model_of
from clresample.deblending.profiles import ComponentProfile
from clresample.deblending.refit import colour_gradient, two_component_fit
from clresample.deblending.refit.colour_gradient import GradientTest, log_evidence_ratio
from clresample.deblending.settings import Settings
from clresample.sky.sources import ExtendedSource, PointSource


@pytest.mark.parametrize("low", [(14, 3), (-9, 3), (2, 20), (2, -9), (40, 40)])
def test_images_beyond_the_observation_have_an_empty_window(low):
    """Whichever edge they lie beyond."""
    rendered = ComponentImages.cropped((1, 2, 10, 12), [low], [np.ones((2, 4, 5))])
    window = rendered.window(0)
    image = rendered.within(0, window)
    assert image.size == 0 and image.shape == np.zeros((2, 10, 12))[:, *window].shape
    assert not np.asarray(rendered).any()


def test_clear_gradients_have_odds_of_7_to_1_for_each_that_is_tested():
    asked = GradientTest(
        np.array([2, 5, 7]), 2 + np.log(3) + np.array([-0.01, 0.01, -np.inf]), np.ones((3, 2))
    )
    assert asked.significant.tolist() == [5]


def fitted(spectra, sources=None, power=1.0, **given):
    """A finished fit as `_candidates` sees it."""
    n = len(spectra)
    sources = [ExtendedSource(position_px=(1, 1))] * n if sources is None else sources
    return SimpleNamespace(
        **{
            "settings": SimpleNamespace(has_multiscale_prior=True),
            "strength_estimates": 1,
            "losses": [3.0, 2.0],
            "fitted": np.arange(n),
            "start": SimpleNamespace(source=np.arange(n)),
            "blend": SimpleNamespace(sources=sources),
            "ties": None,
            "state": SimpleNamespace(spectra=np.array(spectra, float)),
            "scene": SimpleNamespace(spectrum_curvature=np.full((n, 2), power)),
        }
        | given
    )


def test_who_is_asked_for_a_gradient():
    """Sources above signal to noise 30 in more than one channel, whose components are open."""
    spectra = [(24, 18.1), (24, 17.9), (90, 0), (90, 1), (24, 18)]
    assert colour_gradient._candidates(fitted(spectra)).tolist() == [0, 3]
    assert colour_gradient._candidates(fitted(spectra, power=0.25)).tolist() == [3]
    kinds = [
        PointSource(position_px=(1, 1)),
        ExtendedSource(position_px=(1, 1), n_components=1),
        ExtendedSource(position_px=(1, 1), profile=np.ones((3, 3))),
        ExtendedSource(position_px=(1, 1)),
    ]
    assert colour_gradient._candidates(fitted([(90, 90)] * 4, kinds)).tolist() == [3]
    for given in (
        {"strength_estimates": None},
        {"losses": [2.0, np.nan]},
    ):
        assert colour_gradient._candidates(fitted(spectra, **given)).tolist() == []
    assert colour_gradient.run_gradient_tests([fitted(spectra, strength_estimates=None)] * 2) == [
        None,
        None,
    ]


def test_a_gradient_needs_two_channels():
    values, precision, spectrum = np.array([3.0, -3.0]), np.array([4.0, 4.0]), np.array([5.0, 5.0])
    assert np.isfinite(log_evidence_ratio(values, precision, spectrum))
    assert log_evidence_ratio(values, np.array([4.0, 0.0]), spectrum) == -np.inf
    third = [np.append(a, v) for a, v in ((values, 9.0), (precision, 0.0), (spectrum, 1.0))]
    assert log_evidence_ratio(*third) == log_evidence_ratio(
        values, precision, spectrum
    )  # one that sees nothing


@pytest.mark.parametrize("noise", [0.7, 3.0])
def test_evidence_is_asked_of_whitened_residuals(noise):
    """Two observations, three channels, two components and the core of the second: in units of the
    noise, all of the model and the sky taken off; misfit where its light is makes it less certain,
    and a flux under its error counts as that."""
    rng, shape = np.random.default_rng(4), (9, 11)
    spectra, sky = np.array([[3.0, 2.0, 1.0], [5.0, 1e-9, 4.0]]), np.array([0.5, -0.25, 0.125])
    low, parts, views, observed = np.array([[0, 0], [2, 3], [2, 3]]), [], [], []
    slope, power, chi2, light = np.zeros((3, 3)), np.zeros((3, 3)), 0.0, 0.0
    for part in (slice(0, 1), slice(1, 3)):
        parts.append(part)
        n = part.stop - part.start
        images = [rng.random((n, *size)) for size in ((6, 7), (5, 6), (5, 6))]
        observed.append(ComponentImages((3, n, *shape), low, images))
        whole = np.asarray(observed[-1])
        root = rng.uniform(0.5, 1.5, (n, *shape))
        model = np.einsum("ic,icyx->cyx", spectra[:, part], whole[:2]) + sky[part, None, None]
        rest = noise * rng.normal(size=root.shape)
        views.append(SimpleNamespace(sqrt_weights=root, data=model + rest / root))
        whitened = whole * root
        slope[:, part] = np.einsum("icyx,cyx->ic", whitened, rest)
        power[:, part] = np.einsum("icyx,icyx->ic", whitened, whitened)
        own = spectra[1, part, None, None] ** 2 * whole[1] * root**2
        chi2, light = chi2 + (own * rest**2).sum(), light + own.sum()
    covariance = np.array([np.linalg.inv(np.diag(power[:, c]) + 0.1) for c in range(3)])
    fit = SimpleNamespace(
        state=SimpleNamespace(spectra=spectra, sky=sky, morph=[0, 0]),
        views=views,
        scene=SimpleNamespace(channels=lambda: parts),
        ties=None,
    )
    seen = RenderedModel(None, None, covariance, tuple(observed), (), power=power, slope=slope)
    asked = colour_gradient._asked(fit, np.array([1]), seen)
    core = np.einsum("cj,jc->c", covariance[:, 2], slope)
    precision = 1 / covariance[:, 2, 2] / max(chi2 / light, 1)
    flux = np.maximum(spectra[1], 1 / np.sqrt(power[1]))
    assert asked.evidence == pytest.approx(log_evidence_ratio(core, precision, flux), rel=1e-10)
    assert asked.components.tolist() == [1] and (chi2 / light > 1) == (noise > 1)
    np.testing.assert_allclose(asked.power, power[[2]])


def test_what_neighbours_leave_nothing_of_is_not_seen():
    """A millionth of its own precision, and less."""
    slope, power = np.ones((2, 2)), np.full((2, 2), 4.0)
    covariance = np.zeros((2, 2, 2))
    covariance[:, 1, 1] = 1 / (1.1 * 4e-6), 1 / (0.9 * 4e-6)
    values, precision = colour_gradient._eliminated(covariance, slope, power, 1)
    np.testing.assert_allclose(precision, [[4.4e-6, 0]])
    np.testing.assert_allclose(values, [[1 / 4.4e-6, 0]])
    covariance[:, 1, 1] = np.inf, 0.25
    values, precision = colour_gradient._eliminated(covariance, slope, power, 1)
    np.testing.assert_allclose([values[0], precision[0]], [[0, 0.25], [0, 4]])


def ended(n, losses, *, energies=0.0, determined=0.0, findings=True, fixed=()):
    """A finished fit of n components in three channels."""
    found = SimpleNamespace(
        energies=np.full((n, 2), energies),
        strengths=np.full((n, 2), 0.5),
        n_effective=np.full((n, 2), determined),
    )
    return SimpleNamespace(
        strength_estimates=found if findings else None,
        state=SimpleNamespace(morph=[0] * n, spectra=np.zeros((n, 3))),
        scene=SimpleNamespace(fixed=np.isin(np.arange(n), fixed)),
        ties=None,
        losses=losses,
        status="converged",
    )


def test_second_fits_stay_unless_they_describe_the_data_worse():
    """By 20 in half chi2 as if structure did not follow the noise; far better: by the loss."""
    kept, far_better = two_component_fit._is_kept, two_component_fit._is_far_better
    one = ended(2, [200, 100.0])
    assert kept(ended(3, [150, 119.9]), one) and not kept(ended(3, [150, 120.1]), one)
    assert not kept(ended(3, [150, 50.0], findings=False), one)
    # a unit each for three fluxes and a profile's four numbers, and 200
    bright = ended(2, [900, 500.0])
    assert far_better(ended(3, [900, 292.9]), bright)
    assert not far_better(ended(3, [900, 293.1]), bright)
    assert far_better(ended(4, [900, 285.9]), bright)
    assert not far_better(ended(4, [900, 286.1]), bright)
    # 20 of 100 are structure's: half of 0.25^-1 of two scales of two components
    assert two_component_fit._half_chi2(ended(2, [200, 100.0], energies=2.5)) == pytest.approx(80)
    noisy = ended(2, [200, 100.0], energies=2.5, determined=10.0, fixed=(0,))
    assert two_component_fit._half_chi2(noisy) == pytest.approx(90 + 10)


def test_each_scene_keeps_its_second_fit_where_that_is_better(monkeypatch):
    """Whatever the others do; what is not kept gives the shifts of the first fit back."""
    firsts = [named(k, shifts=float(k)) for k in range(5)]
    again = {k: named(10 + k, shifts=9.0, of=firsts[k]) for k in (0, 1, 3, 4)}
    again[4].status = Ended.INTERRUPTED
    monkeypatch.setattr(two_component_fit, "start_refits", lambda fits: again)
    monkeypatch.setattr(two_component_fit, "iterate", lambda *given: None)
    monkeypatch.setattr(two_component_fit, "_is_kept", lambda new, old: new.name != 11)
    monkeypatch.setattr(two_component_fit, "_is_far_better", lambda new, old: new.name != 11)
    kept = two_component_fit.refit_two_components(firsts, Settings(), None, None)
    assert [one.name for one in kept] == [10, 1, 2, 13, 4]
    assert [one.at["shifts"] for one in firsts] == [9, 1, 2, 9, 4]
    assert [one.status == Ended.INTERRUPTED for one in kept] == [False] * 4 + [True]


def test_progress_goes_on_from_the_first_fits():
    told = []
    fits = [SimpleNamespace(losses=[1] * n) for n in (7, 12)]
    two_component_fit._after(fits, lambda n, loss: told.append((n, loss)))(5, 0.5)
    assert told == [(17, 0.5)] and two_component_fit._after(fits, None) is None


def test_morphologies_are_followed_by_the_cores_that_are_asked_about():
    """Each core is the morphology times its profile, where it lies and with its source's PSF."""
    rng = np.random.default_rng(3)
    morphs, profile = ([rng.random((3 + i, 4)) for i in range(3)] for _ in range(2))
    fit = SimpleNamespace(
        scene=SimpleNamespace(profile=profile, origin=np.array([[1, 2], [3, 4], [5, 6]])),
        state=SimpleNamespace(morph=morphs, spectra=rng.random((3, 2)), sky=rng.random(2)),
        start=SimpleNamespace(source=np.array([0, 0, 1]), shapes=[ComponentProfile()] * 3),
        padded=SimpleNamespace(shape=(40, 41)),
        views=["a", "b"],
    )
    model = model_of(fit, [2, 0])
    assert (
        model.frame == (40, 41)
        and model.views == ["a", "b"]
        and model.unfiltered_views == [None, None]
    )
    assert model.source.tolist() == [0, 0, 1, 1, 0]
    assert model.origin.tolist() == [[1, 2], [3, 4], [5, 6], [5, 6], [1, 2]]
    assert model.morphs[:3] == morphs and len(model.morphs) == 5
    np.testing.assert_array_equal(model.morphs[3], morphs[2] * profile[2])
    np.testing.assert_array_equal(model.morphs[4], morphs[0] * profile[0])
    np.testing.assert_array_equal(model.spectra[:3], fit.state.spectra)
    assert model.spectra.shape == (5, 2) and not model.spectra[3:].any()
    assert model.sky is fit.state.sky and len(colour_gradient.model_of(fit).morphs) == 3
