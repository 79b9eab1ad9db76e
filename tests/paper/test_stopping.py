"""When a fit ends, and with which state: convergence, divergence, Ctrl-C."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import BRIGHT, blend, chi2, fit, same

from clresample.deblending.batch import deblend
from clresample.deblending.iterate import CHECK_ITERATIONS
from clresample.paper.run import stop_reason
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.amsgrad import StepSizes
from clresample.paper.solver.engine import Engine
from clresample.paper.solver.prior import SingleScalePrior
from clresample.sky.sources import ExtendedSource


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
    reason = stop_reason(before + now, len(now), 1e-3)
    assert (reason or "iteration limit") == status


def starts(device, b, **given):
    settings = PaperSettings(**({"prior": SingleScalePrior()} | given), max_iter=0)
    return fit(b, device, settings=settings)


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("rate", [1e3, 1e30, 1e38])
def test_divergence_gives_the_best_state(device, rate, prior):
    given = {"step_sizes": StepSizes(rate, rate, rate)} | {
        "prior": SingleScalePrior() if prior else None
    }
    result = fit(blend(), device, settings=PaperSettings(**given))
    assert result.status == "diverged" and not result.converged
    same(result, starts(device, blend(), **given))
    assert np.isfinite(result.losses[-1]) and result.losses[-1] == np.nanmin(result.losses)


@pytest.mark.parametrize("when", [2, 5, 10])
def test_a_nan_gives_the_best_state(device, monkeypatch, when):
    """Also one of the last update of a run, which no loss of that run shows."""
    step = Engine.step

    def broken(self):
        step(self)
        if self.n_steps == when:
            spectra = self.buffers.spectra
            self.device.upload(np.full(spectra.shape, np.nan, np.float32), spectra)

    monkeypatch.setattr(Engine, "step", broken)
    result = fit(
        blend(BRIGHT),
        device,
        settings=PaperSettings(prior=SingleScalePrior(), max_iter=50, rel_tol=0),
    )
    assert result.status == "diverged" and 0.8 < chi2(result) < 1.2
    monkeypatch.undo()
    before = (when - 1) // CHECK_ITERATIONS * CHECK_ITERATIONS
    same(
        result,
        fit(
            blend(BRIGHT),
            device,
            settings=PaperSettings(prior=SingleScalePrior(), max_iter=before, rel_tol=0),
        ),
    )
    assert np.isfinite(result.losses[-1])


def test_rising_losses_give_the_best_state(device):
    """Sources where no light is: the fit ends no worse than it ever was."""
    b = blend()
    wrong = (ExtendedSource(position_px=(-0.5, 12.1)), ExtendedSource(position_px=(29.4, 35.4)))
    settings = PaperSettings(prior=SingleScalePrior())
    result = deblend(b.observations, wrong, frame=b.frame, device=device, settings=settings)
    assert result.losses[-1] <= result.losses[:-1:CHECK_ITERATIONS].min()


def interrupt_call(monkeypatch, where, when):
    """Ctrl-C in call number `when` (from 0) of a method of Engine, once."""
    original, calls = getattr(Engine, where), []

    def method(self, *arguments, **options):
        calls.append(where)
        if len(calls) == when + 1:
            raise KeyboardInterrupt
        return original(self, *arguments, **options)

    monkeypatch.setattr(Engine, where, method)


@pytest.fixture(scope="module")
def uninterrupted(device):
    """Fits without Ctrl-C by their settings, each run once."""
    return functools.cache(lambda settings: fit(blend(BRIGHT), device, settings=settings))


@pytest.mark.parametrize("sizes", [StepSizes(), StepSizes(latent=0.002, spectrum=0.02)])
@pytest.mark.parametrize("when", [0, 3, 12])
@pytest.mark.parametrize("where", ["gradient", "step"])
def test_ctrl_c_gives_the_best_state(device, monkeypatch, uninterrupted, where, when, sizes):
    """However far an iteration has come, and be the state half-way through it a better one."""
    interrupt_call(monkeypatch, where, when)
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=60, rel_tol=0, step_sizes=sizes)
    result = fit(blend(BRIGHT), device, settings=settings)
    assert result.status == "interrupted" and not result.converged
    monkeypatch.undo()
    done = when // CHECK_ITERATIONS * CHECK_ITERATIONS
    whole = uninterrupted(replace(settings, max_iter=max(done, 1)))
    if when or where == "step":
        best = whole.losses[: done + 1 : CHECK_ITERATIONS].min()
        assert result.losses[-1] == pytest.approx(best, rel=1e-6)
        np.testing.assert_array_equal(result.losses[:-1], whole.losses[:done])
    else:
        same(result, starts(device, blend(BRIGHT)))


@pytest.mark.parametrize("when", [0, 1])
def test_ctrl_c_while_an_engine_is_made(device, monkeypatch, when):
    """The first one, or one for boxes of other sizes."""
    interrupt_call(monkeypatch, "__init__", when)
    monkeypatch.setattr("clresample.paper.run.resize_boxes", lambda s, p, *_: (replace(s), p))
    result = fit(
        blend(BRIGHT),
        device,
        settings=PaperSettings(prior=SingleScalePrior(), max_iter=60, rel_tol=0),
    )
    assert result.status == "interrupted" and 0.85 < chi2(result) < 1.1
    if not when:
        same(result, starts(device, blend(BRIGHT)))
    else:
        assert result.losses[-1] <= result.losses[:-1:CHECK_ITERATIONS].min()


def test_ctrl_c_elsewhere_is_not_swallowed(device, monkeypatch):
    """Before anything was fitted there is nothing to return."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("clresample.deblending.fit.fit_start_profiles", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit(blend(), device)
