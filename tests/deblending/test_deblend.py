"""One blend: what comes out of a fit, when it stops, and what it makes of awkward input."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import BRIGHT, blend, chi2, fit, frame, same, sources, truth

from clresample.deblending.batch import deblend
from clresample.deblending.iterate import CHECK, PATIENCE, _stopped
from clresample.deblending.settings import Settings
from clresample.deblending.solver.constraints import Chain, MaxNorm, Monotone, Positivity, SumNorm
from clresample.deblending.solver.engine import Engine
from clresample.deblending.solver.problem import StepSizes
from clresample.resampling.resampler import Resampler
from clresample.sky.sources import Extended

EXACT = Settings(tol=0, max_iter=20)


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
    assert set(plain.seconds) == {"setup", "fit", "result"}


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
    for settings in (EXACT, replace(EXACT, tol=0.5, max_iter=60)):
        result = fit(b, device, settings=replace(settings, prior=None))
        at_limit = settings.tol == 0
        assert result.status == ("iteration limit" if at_limit else "converged")
        assert len(result.losses) == (21 if at_limit else PATIENCE + CHECK + 1)
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
        settings=Settings(max_iter=max_iter, tol=0),
        progress=lambda n, loss: seen.append((n, loss.shape)),
    )
    assert len(result.losses) == max_iter + 1
    assert seen == [(n, (1,)) for n in ([5] if max_iter > 5 else []) + [max_iter]]


class Watched:
    """Stands for a fit under the stopping rule."""

    def __init__(self, losses):
        self.losses, self.status = list(losses), "iteration limit"


@pytest.mark.parametrize(
    ("before", "now", "status"),
    [
        ([100] * 5, [99] * 5, "iteration limit"),  # too early
        ([100] * 15, [100] * 5, "converged"),
        ([100] * 15, [99.5] * 5, "iteration limit"),
        ([100] * 15, [99.95] * 5, "converged"),
        ([100] * 10 + [90] * 5, [90] * 5, "iteration limit"),  # fell within the last 15
        ([100] * 15, [101] * 5, "converged"),  # its best is long ago
        ([100] * 15, [100, 90, 120, 100, 130], "iteration limit"),  # noisy, and better
        ([100], [1001] * 5, "diverged"),
        ([100], [99, 98, np.nan, 97, 96], "diverged"),
        ([100], [99, 98, 97, 96, np.inf], "diverged"),
        ([], [np.nan] * 5, "diverged"),
    ],
)
def test_the_stopping_rule(before, now, status):
    fits = [Watched(before), Watched([100] * 30)]
    losses = np.column_stack([now, [1.0] * 5])
    stop = _stopped(fits, np.array([True, False]), losses, Settings(tol=1e-3))
    assert stop.tolist() == [status != "iteration limit", False]
    assert fits[0].status == status and len(fits[0].losses) == len(before) + 5
    assert len(fits[1].losses) == 30  # it has left


def test_settings_that_cannot_be():
    for wrong, words in (({"max_iter": -1}, "max_iter is -1"), ({"tol": 1.0}, "tol is 1.0")):
        with pytest.raises(ValueError, match=words):
            Settings(**wrong)


def starts(device, b, **given):
    return fit(b, device, settings=Settings(max_iter=0, **given))


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("rate", [1e3, 1e30, 1e38])
def test_divergence_gives_the_best_state(device, rate, prior):
    given = {"rates": StepSizes(rate, rate, rate)} | ({} if prior else {"prior": None})
    result = fit(blend(), device, settings=Settings(**given))
    assert result.status == "diverged" and not result.converged
    same(result, starts(device, blend(), **given))
    assert np.isfinite(result.losses[-1]) and result.losses[-1] == np.nanmin(result.losses)


@pytest.mark.parametrize("when", [2, 5, 10])
def test_a_nan_gives_the_best_state(device, monkeypatch, when):
    """Also one of the last update of a run, which no loss of that run shows."""
    update = Engine.update

    def broken(self):
        update(self)
        if self.n_steps == when:
            self.device.upload(np.full(self.spectra.shape, np.nan, np.float32), self.spectra)

    monkeypatch.setattr(Engine, "update", broken)
    result = fit(blend(BRIGHT), device, settings=Settings(max_iter=50, tol=0))
    assert result.status == "diverged" and 0.8 < chi2(result) < 1.2
    monkeypatch.undo()
    before = (when - 1) // CHECK * CHECK
    same(result, fit(blend(BRIGHT), device, settings=Settings(max_iter=before, tol=0)))
    assert np.isfinite(result.losses[-1])


def test_rising_losses_give_the_best_state(device):
    """Sources where no light is: the fit ends no worse than it ever was."""
    b = blend()
    wrong = (Extended(position_px=(-0.5, 12.1)), Extended(position_px=(29.4, 35.4)))
    result = deblend(b.observations, wrong, frame=b.frame, device=device)
    assert result.losses[-1] <= result.losses[:-1:CHECK].min()


def interrupt_call(monkeypatch, where, when):
    """Ctrl-C in call number `when` (from 0) of a method of Engine, once."""
    original, calls = getattr(Engine, where), []

    def method(self, *arguments, **options):
        calls.append(where)
        if len(calls) == when + 1:
            raise KeyboardInterrupt
        return original(self, *arguments, **options)

    monkeypatch.setattr(Engine, where, method)


@pytest.mark.parametrize("rates", [StepSizes(), StepSizes(field=0.002, spectrum=0.02)])
@pytest.mark.parametrize("when", [0, 3, 12])
@pytest.mark.parametrize("where", ["gradient", "update"])
def test_ctrl_c_gives_the_best_state(device, monkeypatch, where, when, rates):
    """However far an iteration has come, and be the state half-way through it a better one."""
    interrupt_call(monkeypatch, where, when)
    settings = Settings(max_iter=60, tol=0, rates=rates)
    result = fit(blend(BRIGHT), device, settings=settings)
    assert result.status == "interrupted" and not result.converged
    monkeypatch.undo()
    done = when // CHECK * CHECK
    whole = fit(blend(BRIGHT), device, settings=replace(settings, max_iter=max(done, 1)))
    if when or where == "update":
        best = whole.losses[: done + 1 : CHECK].min()
        assert result.losses[-1] == pytest.approx(best, rel=1e-6)
        np.testing.assert_array_equal(result.losses[:-1], whole.losses[:done])
    else:
        same(result, starts(device, blend(BRIGHT)))


@pytest.mark.parametrize("when", [0, 1])
def test_ctrl_c_while_an_engine_is_made(device, monkeypatch, when):
    """The first one, or one for boxes of other sizes."""
    interrupt_call(monkeypatch, "__init__", when)
    monkeypatch.setattr("clresample.deblending.iterate.resized", lambda p, *_: replace(p))
    result = fit(blend(BRIGHT), device, settings=Settings(max_iter=60, tol=0))
    assert result.status == "interrupted" and 0.85 < chi2(result) < 1.1
    if not when:
        same(result, starts(device, blend(BRIGHT)))
    else:
        assert result.losses[-1] <= result.losses[:-1:CHECK].min()


def test_ctrl_c_elsewhere_is_not_swallowed(device, monkeypatch):
    """Before anything was fitted there is nothing to return."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("clresample.deblending.fit.start", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit(blend(), device)


def test_constraints_are_kept(device):
    chain = Chain(Positivity(), Monotone(), MaxNorm())
    settings = Settings(prior=None, constraints=chain, max_iter=30, tol=0)
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
        Settings(constraints=Chain(Positivity(), norm))
    assert Settings(constraints=Chain(Positivity(), norm), prior=None).prior is None
