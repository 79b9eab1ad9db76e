"""Many blends side by side, of which some fail, diverge or are interrupted: the others come out."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import alike, blend, chi2, frame
from helpers.tuning import tune

from clresample.deblending.batch import deblend_many
from clresample.deblending.blend import Failure
from clresample.deblending.fit import Fit
from clresample.deblending.result import Result
from clresample.device.discovery import DeviceError
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.engine import Engine
from clresample.paper.solver.prior import SingleScalePrior
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.sources import ExtendedSource

SETTINGS = PaperSettings(prior=SingleScalePrior(), max_iter=30, rel_tol=0)


def fit(b, device, settings=SETTINGS, **given):
    return scenes.fit(b, device, settings=settings, **given)


def failing():
    """Blends that cannot be fitted, and words of why."""
    good = blend()
    o = good.observations[0]
    nan = Observation(np.nan * o.data, o.psf, o.grid, weights=o.weights, channels=o.channels)
    far = Frame(Grid.flat((30, 36), 0.1, center_arcsec=(60, 0)), frame().psf)
    ring = ExtendedSource(position_px=(15, 18), profile=np.ones((4, 4)))
    return [
        (replace(good, sources=(ExtendedSource(position_px=(99, 3)),)), "none of the 1 sources"),
        (replace(good, sources=()), "sources"),
        (replace(good, observations=(nan,)), "no observed pixel on the model frame has a weight"),
        (replace(good, observations=()), "observations is empty"),
        (replace(good, observations=good.observations * 2), "channel name 'v' is given twice"),
        (replace(good, frame=far), "do not overlap"),
        (replace(good, sources=(ring,)), r"shape \(4, 4\)"),
        (replace(good, shifts=np.zeros(3)), "shifts is"),
    ]


def test_failures_are_reported_and_harm_nobody(device):
    bad = failing()
    blends = [blend(seed=1)]
    for b, _ in bad:
        blends += [b, blend(seed=len(blends) + 1)]
    seen = []
    results = deblend_many(blends, settings=SETTINGS, device=device, progress=seen.append)
    for i, (b, words) in enumerate(bad):
        failed = results[2 * i + 1]
        assert isinstance(failed, Failure) and failed.blend is b and not failed.converged
        pytest.raises(ValueError, _refuse, failed).match(words)
    assert seen == sorted(seen) and seen[-1] == len(blends)
    for b, result in zip(blends[::2], results[::2], strict=True):
        alike(result, fit(b, device))


def _refuse(failed):
    raise ValueError(failed.reason)


def test_failures_of_the_device_and_of_results(device, monkeypatch):
    """Fits of a group that fails are done one by one; a failed result is one failure."""
    blends = [blend(seed=i) for i in range(4)]
    original, result = Engine.__init__, Fit.result

    def small(self, scenes, *arguments, **options):
        if len(scenes) > 1:
            raise DeviceError("no memory for so many")
        original(self, scenes, *arguments, **options)

    def third(self, seen):
        if self.blend is blends[2]:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return result(self, seen)

    monkeypatch.setattr(Engine, "__init__", small)
    monkeypatch.setattr(Fit, "result", third)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    monkeypatch.undo()
    assert results[2].reason == "Matrix is not positive definite"
    for i in (0, 1, 3):
        alike(results[i], fit(blends[i], device))

    def none(self, scenes, *arguments, **options):
        raise DeviceError("no memory at all")

    monkeypatch.setattr(Engine, "__init__", none)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    assert [r.reason for r in results] == ["no memory at all"] * 4
    with pytest.raises(DeviceError, match="no memory at all"):
        fit(blends[0], device)


def test_a_diverging_blend_harms_nobody(device, monkeypatch):
    blends = [blend(seed=i) for i in range(3)]
    step = Engine.step

    def broken(self):
        step(self)
        if self.n_steps == 7 and len(self.scenes) == 3:
            spectra = self.device.get(self.buffers.spectra)
            spectra[2:4] = np.nan  # scene 1
            self.device.upload(spectra, self.buffers.spectra)

    monkeypatch.setattr(Engine, "step", broken)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    monkeypatch.undo()
    assert [r.status for r in results] == ["iteration limit", "diverged", "iteration limit"]
    assert chi2(results[1]) < 1.1 and np.isfinite(results[1].losses[-1])
    for i in (0, 2):
        alike(results[i], fit(blends[i], device))


def test_ctrl_c_loses_nothing(device, monkeypatch):
    """Groups done are returned, that which runs as it stands, the rest as failures."""
    tune(monkeypatch, n_scenes=2)
    blends = [blend(seed=i) for i in range(5)]
    gradient, calls = Engine.gradient, []

    def interrupted(self, i_loss=0):
        calls.append(self)
        if len(calls) == 31 + 8:  # the first group has its 30 and a last one
            raise KeyboardInterrupt
        gradient(self, i_loss)

    monkeypatch.setattr(Engine, "gradient", interrupted)
    seen = []
    results = deblend_many(blends, settings=SETTINGS, device=device, progress=seen.append)
    monkeypatch.undo()
    status = ["iteration limit"] * 2 + ["interrupted"] * 3
    assert [r.status for r in results] == status and seen == [2, 4]
    for i in (0, 1):
        alike(results[i], fit(blends[i], device))
    for i in (2, 3):
        assert isinstance(results[i], Result) and chi2(results[i]) < 1.1
        assert len(results[i].losses) == 6
    assert isinstance(results[4], Failure) and results[4].blend is blends[4]


@pytest.mark.parametrize("where", ["__init__", "result"])
def test_ctrl_c_between_fits_loses_nothing(device, monkeypatch, where):
    tune(monkeypatch, n_scenes=2)
    blends = [blend(seed=i) for i in range(5)]
    original = getattr(Fit, where)

    def interrupted(self, *arguments, **options):
        if (self.blend if where == "result" else arguments[0]) is blends[3]:
            raise KeyboardInterrupt
        return original(self, *arguments, **options)

    monkeypatch.setattr(Fit, where, interrupted)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    done = 2 if where == "__init__" else 3
    assert [isinstance(r, Result) for r in results] == [True] * done + [False] * (5 - done)
    assert [r.status for r in results[done:]] == ["interrupted"] * (5 - done)
