"""Many blends side by side: each as if alone, in their order, whatever becomes of the others."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import GALAXIES, blend, chi2, frame

from clresample.deblending import batch, iterate
from clresample.deblending.batch import deblend_many
from clresample.deblending.blend import Blend, Failure
from clresample.deblending.fit import Fit
from clresample.deblending.result import Result
from clresample.deblending.settings import Settings
from clresample.deblending.solver.engine import Engine
from clresample.device.discovery import DeviceError
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import Extended, Point

SETTINGS = Settings(max_iter=30, tol=0)
CORNER = ((28.0, 34.0), (25, 60, 50), 1.6)
STAR = ((5.0, 20.0), (40, 30, 60), 0)


def ragged():
    """Sizes, numbers of sources, PSFs, angles and instruments of each blend's own."""
    wide = PSF.gaussian(1.0, n_pixels=19), PSF.gaussian(1.2, n_pixels=21, n_bands=2)
    blends = [
        blend(seed=0),
        blend(GALAXIES[:1], seed=1, psfs=wide),
        blend((CORNER, STAR), seed=2, angle=-40),
        blend((*GALAXIES, CORNER), seed=3, shape=(33, 37)),
        blend((CORNER, *GALAXIES), seed=4, shape=(31, 40), angle=0),
        blend(GALAXIES, seed=5, angle=70),
    ]
    alone = blend((CORNER,), seed=6)
    blends.append(replace(alone, observations=alone.observations[:1]))
    blends.append(replace(blend(GALAXIES, seed=7, shape=(29, 35)), frame=None))
    return blends


def fit(b, device, settings=SETTINGS, **given):
    return scenes.fit(b, device, settings=settings, **given)


def alike(together, alone, dtype=np.float32):
    """To what sums leave after 30 steps, each of which divides a gradient by its own size, and so
    makes of the rounding of the smallest ones steps of the rate's size."""
    close = dtype == np.float64
    assert together.frame.shape == alone.frame.shape and together.status == alone.status
    np.testing.assert_allclose(together.losses, alone.losses, rtol=1e-9 if close else 5e-4)
    np.testing.assert_allclose(together.shifts, alone.shifts, atol=1e-8 if close else 1e-3)
    np.testing.assert_allclose(together.sky, alone.sky, atol=1e-8 if close else 1e-3)
    for k, o in enumerate(alone.observations):
        assert together.model(k).shape == o.shape
        away = (together.model(k) - alone.model(k)) * np.sqrt(o.weights)
        assert np.abs(away).max() < (1e-6 if close else 0.05)  # sigma
        # what one does not cover, the other does not either; a faint pixel may round to nothing
        dark = (together.model(k) == 0) != (alone.model(k) == 0)
        assert np.abs(away + alone.model(k) * np.sqrt(o.weights))[dark].max(initial=0) < 1e-3
        assert np.abs(alone.model(k) * np.sqrt(o.weights))[dark].max(initial=0) < 1e-3
    for c, d in zip(together.components, alone.components, strict=True):
        assert (c.source, c.origin) == (d.source, d.origin)
        assert c.morphology.shape == d.morphology.shape
        together.source_model(c.source)  # its box lies inside the frame


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        replace(SETTINGS, fit_sky=True),
        replace(SETTINGS, fit_shifts=True),
        replace(SETTINGS, prior=None),
    ],
    ids=["plain", "sky", "shifts", "free"],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=lambda t: t.__name__)
def test_each_is_as_if_alone(device, settings, dtype):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    blends = ragged()
    results = deblend_many(blends, settings=settings, device=device, dtype=dtype)
    for b, result in zip(blends, results, strict=True):
        assert isinstance(result, Result), result.status
        alike(result, fit(b, device, settings, dtype=dtype), dtype)


def test_known_shifts_of_each(device):
    """In one group, and in another engine once boxes have changed."""
    settings = Settings(max_iter=45, tol=0)
    moves = [(0.5, 0.5), (-1.0, 0.7), (0.0, 0.0)]
    blends = [
        replace(blend(seed=i, shift=move), shifts=np.array([(0, 0), move]))
        for i, move in enumerate(moves)
    ]
    results = deblend_many(blends, settings=settings, device=device)
    for b, result in zip(blends, results, strict=True):
        alike(result, fit(b, device, settings, shifts=b.shifts))
        assert chi2(result) < 1.1


def test_the_best_state_has_its_own_shifts(device, monkeypatch):
    """A shift that makes everything worse is taken back with what came of it."""

    def astray(problem):
        return np.array([(0.0, 0.0), (2.5, -2.0)])

    monkeypatch.setattr(iterate, "shift_steps", astray)
    settings = Settings(max_iter=15, tol=0, fit_shifts=True)
    blends = [blend(seed=i) for i in range(2)]
    for result in deblend_many(blends, settings=settings, device=device):
        assert not result.shifts.any() and chi2(result) < 1.1


def test_equal_blends_share_a_group_and_boxes_move(device, monkeypatch):
    """Of one size: one group, no padding, and the resizing of boxes in it."""
    engines = watch_engines(monkeypatch)
    blends = [blend(seed=i) for i in range(4)]
    settings = Settings(max_iter=50, tol=0)
    results = deblend_many(blends, settings=settings, device=device)
    assert engines[0] == 4 and results[0].frame.shape == (30, 36)
    for b, result in zip(blends, results, strict=True):
        alike(result, fit(b, device, settings))


def watch_engines(monkeypatch):
    """Numbers of scenes of the engines made from now on."""
    engines, original = [], Engine.__init__

    def made(self, problems, *arguments, **options):
        engines.append(len(problems))
        original(self, problems, *arguments, **options)

    monkeypatch.setattr(Engine, "__init__", made)
    return engines


def test_fits_that_stop_leave_the_batch_and_keep_their_state(device, monkeypatch):
    """One by one, as losses settle; the others go on in smaller engines."""
    engines = watch_engines(monkeypatch)
    stopped = {0: 10, 2: 20, 3: 20}  # of four, at these iterations
    fits, original = [], iterate._stopped

    def stop(running, live, losses, settings):
        original(running, live, losses, settings)
        if not fits:
            fits.extend(running)
        n = len(running[int(np.argmax(live))].losses)
        ends = [
            stopped.get(fits.index(f), 99) <= n and on for f, on in zip(running, live, strict=True)
        ]
        for f, end in zip(running, ends, strict=True):
            f.status = "converged" if end else f.status
        return np.array(ends)

    monkeypatch.setattr(iterate, "_stopped", stop)
    blends = [blend(seed=i) for i in range(4)]
    results = deblend_many(blends, settings=SETTINGS, device=device)
    assert engines == [4, 3, 1]
    monkeypatch.undo()
    assert [len(r.losses) for r in results] == [11, 31, 21, 21]
    for b, result, n in zip(blends, results, (10, 30, 20, 20), strict=True):
        alone = fit(b, device, replace(SETTINGS, max_iter=n))
        alike(result, replace(alone, status=result.status))


def failing():
    """Blends that cannot be fitted, and words of why."""
    good = blend()
    o = good.observations[0]
    nan = Observation(np.nan * o.data, o.psf, o.grid, weights=o.weights, channels=o.channels)
    far = Frame(Grid.flat((30, 36), 0.1, center_arcsec=(60, 0)), frame().psf)
    ring = Extended(position_px=(15, 18), profile=np.ones((4, 4)))
    return [
        (replace(good, sources=(Extended(position_px=(99, 3)),)), "none of the 1 sources"),
        (replace(good, sources=()), "sources"),
        (replace(good, observations=(nan,)), "no observed pixel on the model frame has a weight"),
        (replace(good, observations=()), "observations is empty"),
        (replace(good, observations=good.observations * 2), "channel name 'v' is given twice"),
        (replace(good, frame=far), "do not overlap"),
        (replace(good, sources=(ring,)), r"shape \(4, 4\)"),
        (replace(good, shifts=np.zeros(3)), "shifts is"),
    ]


def test_failures_are_told_and_harm_nobody(device):
    bad = failing()
    blends = [blend(seed=1)]
    for b, _ in bad:
        blends += [b, blend(seed=len(blends) + 1)]
    seen = []
    results = deblend_many(blends, settings=SETTINGS, device=device, progress=seen.append)
    for i, (b, words) in enumerate(bad):
        failed = results[2 * i + 1]
        assert isinstance(failed, Failure) and failed.blend is b and not failed.converged
        pytest.raises(ValueError, _refuse, failed).match(f"^failed: .*{words}")
    assert seen == sorted(seen) and seen[-1] == len(blends)
    for b, result in zip(blends[::2], results[::2], strict=True):
        alike(result, fit(b, device))


def _refuse(failed):
    raise ValueError(failed.status)


def test_failures_of_the_device_and_of_results(device, monkeypatch):
    """What a whole group cannot do is done one by one; a result that fails is one failure."""
    blends = [blend(seed=i) for i in range(4)]
    original, result = Engine.__init__, Fit.result

    def small(self, problems, *arguments, **options):
        if len(problems) > 1:
            raise DeviceError("no memory for so many")
        original(self, problems, *arguments, **options)

    def third(self):
        if self.blend is blends[2]:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return result(self)

    monkeypatch.setattr(Engine, "__init__", small)
    monkeypatch.setattr(Fit, "result", third)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    monkeypatch.undo()
    assert results[2].status == "failed: Matrix is not positive definite"
    for i in (0, 1, 3):
        alike(results[i], fit(blends[i], device))

    def none(self, problems, *arguments, **options):
        raise DeviceError("no memory at all")

    monkeypatch.setattr(Engine, "__init__", none)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    assert [r.status for r in results] == ["failed: no memory at all"] * 4
    with pytest.raises(DeviceError, match="no memory at all"):
        fit(blends[0], device)


def test_a_diverging_blend_harms_nobody(device, monkeypatch):
    blends = [blend(seed=i) for i in range(3)]
    update = Engine.update

    def broken(self):
        update(self)
        if self.n_steps == 7 and len(self.problems) == 3:
            spectra = self.device.get(self.spectra)
            spectra[2:4] = np.nan  # scene 1
            self.device.upload(spectra, self.spectra)

    monkeypatch.setattr(Engine, "update", broken)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    monkeypatch.undo()
    assert [r.status for r in results] == ["iteration limit", "diverged", "iteration limit"]
    assert chi2(results[1]) < 1.1 and np.isfinite(results[1].losses[-1])
    for i in (0, 2):
        alike(results[i], fit(blends[i], device))


def test_ctrl_c_loses_nothing(device, monkeypatch):
    """Groups done are returned, that which runs as it stands, the rest as failures."""
    monkeypatch.setattr(batch, "SCENES", {device.kind: 2})
    monkeypatch.setattr(batch, "SCENES_ELSEWHERE", 2)
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
    monkeypatch.setattr(batch, "SCENES", {device.kind: 2})
    monkeypatch.setattr(batch, "SCENES_ELSEWHERE", 2)
    blends = [blend(seed=i) for i in range(5)]
    original = getattr(Fit, where)

    def interrupted(self, *arguments, **options):
        if (arguments[0] if arguments else self.blend) is blends[3]:
            raise KeyboardInterrupt
        return original(self, *arguments, **options)

    monkeypatch.setattr(Fit, where, interrupted)
    results = deblend_many(blends, settings=SETTINGS, device=device)
    done = 2 if where == "__init__" else 3
    assert [isinstance(r, Result) for r in results] == [True] * done + [False] * (5 - done)
    assert [r.status for r in results[done:]] == ["interrupted"] * (5 - done)


def test_a_memory_budget_splits_groups(device, monkeypatch):
    engines = watch_engines(monkeypatch)
    blends = [blend(seed=i) for i in range(4)]
    settings = replace(SETTINGS, max_iter=5)
    together = deblend_many(blends, settings=settings, device=device)
    assert engines == [4]
    one = Fit(blends[0], settings, device, np.float32, pad=1).bytes
    for memory, sizes in ((1, [1] * 4), (2.5 * one, [2, 2]), (10 * one, [4])):
        engines.clear()
        results = deblend_many(blends, settings=settings, device=device, memory=memory)
        assert engines == sizes
        for a, b in zip(results, together, strict=True):
            alike(a, b)


def test_the_budget_counts_what_a_scene_takes(device):
    """Of the arrays of an engine on the device, within a factor of two."""
    fits = [Fit(blend(seed=i), SETTINGS, device, np.float32, pad=1) for i in range(8)]
    gc.collect()
    before = device.in_use
    engine = iterate._engine(fits, SETTINGS, device, np.float32)
    engine.run(1)
    used, told = device.in_use - before, sum(f.bytes for f in fits)
    assert 0.5 * told < used < 2 * told


def test_device_memory_stays_constant(device, monkeypatch):
    """Over 64 blends in groups of 8, with PSFs and so operators of their own now and then."""
    monkeypatch.setattr(batch, "SCENES", {device.kind: 8})
    monkeypatch.setattr(batch, "SCENES_ELSEWHERE", 8)
    settings, held = Settings(max_iter=2), []
    psf = PSF.gaussian(1.1, n_pixels=11)
    grid, psf_in = Grid.flat((20, 22), 0.1), PSF.gaussian(0.8, n_pixels=11)
    rng = np.random.default_rng(0)

    def tiny(i):
        data = rng.normal(size=(20, 22)) + 50 * (np.indices((20, 22)).sum(0) == 20)
        o = Observation(data, psf, grid, weights=1.0, channels=("r",), name="r")
        return Blend((o,), (Point(position_px=(10, 10)),), Frame(grid, psf_in))

    def watch(n):
        gc.collect()
        held.append(device.in_use)

    results = deblend_many(
        [tiny(i) for i in range(64)], settings=settings, device=device, progress=watch
    )
    assert all(isinstance(r, Result) for r in results) and len(held) == 8
    assert max(held[1:]) - min(held[1:]) == 0


def test_order_progress_and_nothing_to_do(device):
    blends = ragged()
    seen = []
    settings = replace(SETTINGS, max_iter=2)
    results = deblend_many(iter(blends), settings=settings, device=device, progress=seen.append)
    for b, result in zip(blends, results, strict=True):
        assert result.observations is b.observations and result.sources == b.sources
    assert seen == sorted(set(seen)) and seen[-1] == len(blends)
    assert deblend_many([], device=device) == []


def test_missing_instruments(device):
    """Missing instruments make groups of their own; scenes of one share it."""
    blends = [
        replace(b, observations=b.observations[k:])
        for b in (blend(), blend(seed=1))
        for k in (0, 1)
    ]
    results = deblend_many(blends, settings=SETTINGS, device=device)
    assert [len(r.channels) for r in results] == [3, 2, 3, 2]
    for b, result in zip(blends, results, strict=True):
        alike(result, fit(b, device))
