"""One blend: what comes out of a fit, and what settings it takes."""

import numpy as np
import pytest
from helpers.scenes import BRIGHT, blend, chi2, fit, frame, sources, truth

from clresample.deblending import blend as blend_module
from clresample.deblending.batch import deblend
from clresample.deblending.iterate import CHECK_ITERATIONS
from clresample.deblending.settings import Settings
from clresample.measurement.catalogue import catalogue
from clresample.measurement.quality import summary
from clresample.paper.run import PATIENCE
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.constraints import (
    MaxNorm,
    Monotone,
    Positivity,
    ProxChain,
    SumNorm,
)
from clresample.paper.solver.prior import SingleScalePrior
from clresample.resampling.resampler import Resampler
from clresample.sky import frame as frame_module
from clresample.sky.grid import Grid

EXACT = Settings(max_iter=20)


@pytest.fixture(scope="module")
def plain(device):
    return fit(blend(BRIGHT), device)


def test_galaxies_are_found(plain):
    assert plain.status in ("converged", "iteration limit") and 0.85 < chi2(plain) < 1.05
    for i, (drawn, component) in enumerate(zip(BRIGHT, plain.components, strict=True)):
        assert component.source == i and component.morphology.max() == pytest.approx(1)
        np.testing.assert_allclose(component.flux, drawn[1], rtol=0.03)
        model, want = plain.source_model(i), truth([drawn])
        error = np.linalg.norm(model - want, axis=(1, 2)) / np.linalg.norm(want, axis=(1, 2))
        assert error.max() < 0.05
    assert plain.covariance.shape == (3, 2, 2) and not plain.sky.any() and not plain.messages
    assert set(plain.seconds) == {"setup", "fit", "components", "result", "errors"}


def test_observations_are_checked_and_mapped_once(device, monkeypatch):
    """Once in a fit; and once more for all that is measured on its result."""
    checked, mapped = [], []
    original = Grid.map_to

    def check(observations):
        checked.append(observations)

    def map_to(self, *arguments, **options):
        mapped.append(self)
        return original(self, *arguments, **options)

    for module in (blend_module, frame_module):
        monkeypatch.setattr(module, "check_observations", check)
    b = blend(BRIGHT)
    for home in (b.frame, None):
        checked.clear()
        result = deblend(
            b.observations, b.sources, frame=home, device=device, settings=Settings(max_iter=1)
        )
        assert len(checked) == 1
    monkeypatch.setattr(Grid, "map_to", map_to)
    catalogue(result), summary(result), catalogue(result)
    assert not mapped  # the footprints of the fit serve the catalogue
    assert result.footprints is result.footprints


def test_rendered_models_are_the_model_seen(plain):
    """Frame model through an operator made anew = sum of spectra times rendered."""
    whole = sum(plain.source_model(i) for i in range(2))
    for i, (o, part) in enumerate(zip(plain.observations, plain.channel_slices(), strict=True)):
        op = Resampler(plain.frame.grid, plain.frame.psf, o.grid, o.psf)
        wanted = op.forward(whole[part])
        np.testing.assert_allclose(plain.model(i), wanted, rtol=0, atol=3e-6 * wanted.max())
        assert (plain.model(i)[:, ~op.covered] == 0).all()


def test_losses_are_those_of_what_is_returned(device):
    """One before each iteration and one at the end: without a prior, half of chi2."""
    b = blend(BRIGHT)
    for settings in (
        PaperSettings(rel_tol=0, max_iter=20),
        PaperSettings(rel_tol=0.5, max_iter=60),
    ):
        result = fit(b, device, settings=settings)
        at_limit = settings.rel_tol == 0
        assert result.status == ("iteration limit" if at_limit else "converged")
        assert len(result.losses) == (21 if at_limit else PATIENCE + CHECK_ITERATIONS + 1)
        n = sum(np.count_nonzero(o.weights) for o in b.observations)
        outside = sum(
            np.nansum(o.data[:, ~covered(o)] ** 2 * o.weights[:, ~covered(o)])
            for o in b.observations
        )
        # the result's spectra are solved once more: never for the worse
        assert chi2(result) * n - outside <= 2 * result.losses[-1] * (1 + 1e-5)
        assert chi2(result) * n - outside > 2 * result.losses[-1] * 0.98


def covered(observation):
    return observation.grid.map_to(frame().grid).covered


def test_no_iteration_is_the_start(device):
    result = fit(blend(), device, settings=Settings(max_iter=0))
    assert result.status == "iteration limit" and len(result.losses) == 0
    assert np.isfinite(chi2(result))


@pytest.mark.parametrize("max_iter", [1, 4, 5, 7])
def test_the_iteration_limit_is_kept(device, max_iter):
    seen = []
    result = fit(
        blend(),
        device,
        settings=PaperSettings(prior=SingleScalePrior(), max_iter=max_iter, rel_tol=0),
        progress=lambda n, loss: seen.append((n, loss.shape)),
    )
    assert len(result.losses) == max_iter + 1
    assert seen == [(n, (1,)) for n in ([5] if max_iter > 5 else []) + [max_iter]]


def test_settings_that_cannot_be():
    for wrong, words in (
        ({"max_iter": -1}, "max_iter is -1"),
        ({"loss_tol": -1.0}, "loss_tol is -1"),
    ):
        with pytest.raises(ValueError, match=words):
            Settings(**wrong)


def test_constraints_are_kept(device):
    chain = ProxChain(Positivity(), Monotone(), MaxNorm())
    settings = PaperSettings(prior=None, constraints=chain, max_iter=30, rel_tol=0)
    result = fit(blend(BRIGHT), device, settings=settings)
    for c in result.components:
        assert c.morphology.min() >= 0 and c.morphology.max() == pytest.approx(1)
    assert chi2(result) < 1.2


def test_a_second_run_gives_the_same_bits(device, plain):
    again = fit(blend(BRIGHT), device)
    np.testing.assert_array_equal(again.losses, plain.losses)
    for a, b in zip(again.components, plain.components, strict=True):
        np.testing.assert_array_equal(a.morphology, b.morphology)


def test_given_sources_are_in_their_places(plain):
    assert plain.sources == sources(BRIGHT)


@pytest.mark.parametrize("norm", [MaxNorm(), SumNorm()])
def test_a_normalisation_beside_a_prior_is_refused(norm):
    with pytest.raises(ValueError, match=r"constraints hold (Max|Sum)Norm"):
        PaperSettings(prior=SingleScalePrior(), constraints=ProxChain(Positivity(), norm))
    assert PaperSettings(constraints=ProxChain(Positivity(), norm), prior=None).prior is None
