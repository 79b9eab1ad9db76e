"""Many blends side by side: each as if alone, in their order, in groups that fit the device."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import GALAXIES, alike, blend, chi2
from helpers.tuning import tune

from clresample.deblending.batch import deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.fit import Fit, scene_bytes, start_fits
from clresample.deblending.result import Result
from clresample.paper import run as paper_run
from clresample.paper.run import FitTrack
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.engine import Engine
from clresample.paper.solver.prior import SingleScalePrior
from clresample.sky.frame import Frame, model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import PointSource

SETTINGS = PaperSettings(prior=SingleScalePrior(), max_iter=30, rel_tol=0)
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
    framed = blend(GALAXIES, seed=7, shape=(29, 35))
    grid = model_frame(framed.observations).grid
    at = [framed.frame.grid.positions_in(grid, *s.position_px) for s in framed.sources]
    sources = [replace(s, position_px=tuple(p)) for s, p in zip(framed.sources, at, strict=True)]
    blends.append(replace(framed, sources=tuple(sources), frame=None))
    return blends


def fit(b, device, settings=SETTINGS, **given):
    return scenes.fit(b, device, settings=settings, **given)


@pytest.mark.parametrize(
    ("given", "dtype"),
    [
        ({}, np.float32),
        ({}, np.float64),
        ({"fit_sky": True}, np.float32),
        ({"fit_shifts": True}, np.float64),
        ({"prior": None}, np.float32),
    ],
)
def test_each_is_as_if_alone(device, given, dtype):
    settings = replace(SETTINGS, **given)
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    blends = ragged()
    results = deblend_many(blends, settings=settings, device=device, dtype=dtype)
    for b, result in zip(blends, results, strict=True):
        assert isinstance(result, Result), result.status
        alike(result, fit(b, device, settings, dtype=dtype), dtype)


def test_known_shifts_of_each(device):
    """In one group, and in another engine once boxes have changed."""
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=45, rel_tol=0)
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

    def astray(scene, state):
        return np.array([(0.0, 0.0), (2.5, -2.0)]), 0.0

    monkeypatch.setattr(paper_run, "shift_steps", astray)
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=15, rel_tol=0, fit_shifts=True)
    blends = [blend(seed=i) for i in range(2)]
    for result in deblend_many(blends, settings=settings, device=device):
        assert not result.shifts.any() and chi2(result) < 1.1


def test_equal_blends_share_a_group_and_boxes_move(device, monkeypatch):
    """Of one size: one group, no padding, and the resizing of boxes in it."""
    engines = watch_engines(monkeypatch)
    blends = [blend(seed=i) for i in range(4)]
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=50, rel_tol=0)
    results = deblend_many(blends, settings=settings, device=device)
    assert engines[0] == 4 and results[0].frame.shape == (30, 36)
    for b, result in zip(blends, results, strict=True):
        alike(result, fit(b, device, settings))


def watch_engines(monkeypatch):
    """Numbers of scenes of the engines made from now on."""
    engines, original = [], Engine.__init__

    def made(self, scenes, *arguments, **options):
        engines.append(len(scenes))
        original(self, scenes, *arguments, **options)

    monkeypatch.setattr(Engine, "__init__", made)
    return engines


def test_fits_that_stop_leave_the_batch_and_keep_their_state(device, monkeypatch):
    """One by one, as losses settle; the others go on in smaller engines."""
    engines = watch_engines(monkeypatch)
    ends = {0: 10, 2: 20, 3: 20}  # of four, at these iterations
    original = FitTrack.stopped

    def stopped(self, losses):
        original(self, losses)
        fit = self.fit
        end = len(fit.losses) >= ends.get(blends.index(fit.blend), 99)
        fit.status = "converged" if end else fit.status
        return end

    monkeypatch.setattr(FitTrack, "stopped", stopped)
    blends = [blend(seed=i) for i in range(4)]
    results = deblend_many(blends, settings=SETTINGS, device=device)
    assert engines == [4, 3, 1]
    monkeypatch.undo()
    assert [len(r.losses) for r in results] == [11, 31, 21, 21]
    for b, result, n in zip(blends, results, (10, 30, 20, 20), strict=True):
        alone = fit(b, device, replace(SETTINGS, max_iter=n))
        alike(result, replace(alone, status=result.status))


def test_a_memory_budget_splits_groups(device, monkeypatch):
    engines = watch_engines(monkeypatch)
    blends = [blend(seed=i) for i in range(4)]
    settings = replace(SETTINGS, max_iter=5)
    together = deblend_many(blends, settings=settings, device=device)
    assert engines == [4]
    fits = [Fit(b, settings, device, np.float32, pad=1) for b in blends]
    start_fits(fits)
    one = max(map(scene_bytes, fits))
    for memory, sizes in ((1, [1] * 4), (2.9 * one, [2, 2]), (10 * one, [4])):
        engines.clear()
        results = deblend_many(blends, settings=settings, device=device, memory=memory)
        assert engines == sizes
        for a, b in zip(results, together, strict=True):
            alike(a, b)


def test_the_budget_counts_what_a_scene_takes(device):
    """With data and weights, of which all numbers are counted as float64 and are float32."""
    fits = [Fit(blend(seed=i), SETTINGS, device, np.float32, pad=1) for i in range(8)]
    gc.collect()
    before = device.in_use  # data and weights of the fits come with their start
    start_fits(fits)
    running = SETTINGS.start_run(fits, device, np.float32)
    running.engine.run(1)
    gc.collect()
    used, counted = device.in_use - before, sum(f.scene.n_bytes for f in fits)
    assert 0.4 * counted < used < 0.7 * counted


@pytest.mark.counts_memory
def test_device_memory_stays_constant(device, monkeypatch):
    """Over 64 blends in groups of 8, with PSFs and so operators of their own now and then."""
    tune(monkeypatch, n_scenes=8)
    settings, held = PaperSettings(prior=SingleScalePrior(), max_iter=2), []
    psf = PSF.gaussian(1.1, n_pixels=11)
    grid, psf_in = Grid.flat((20, 22), 0.1), PSF.gaussian(0.8, n_pixels=11)
    rng = np.random.default_rng(0)

    def tiny(i):
        data = rng.normal(size=(20, 22))
        data[5:16, 5:16] += 500 * psf.images[0]
        o = Observation(data, psf, grid, weights=1.0, channels=("r",), name="r")
        return Blend((o,), (PointSource(position_px=(10, 10)),), Frame(grid, psf_in))

    def watch(n):
        gc.collect()
        held.append(device.in_use)

    results = deblend_many(
        [tiny(i) for i in range(64)], settings=settings, device=device, progress=watch
    )
    assert all(isinstance(r, Result) for r in results) and len(held) == 8
    assert max(held[1:]) - min(held[1:]) == 0


def test_groups_prepared_ahead_come_out_the_same(device, monkeypatch):
    """A failure among them, and what Ctrl-C leaves: as where one group follows the other."""
    blends = [blend(seed=i) for i in range(5)]
    blends.insert(3, replace(blends[0], sources=()))
    given = {"settings": replace(SETTINGS, max_iter=5), "device": device}
    tune(monkeypatch, n_scenes=2, prefetch_groups=False)
    alone, seen = deblend_many(blends, **given), []
    tune(monkeypatch, n_scenes=2, prefetch_groups=True)
    results = deblend_many(blends, progress=seen.append, **given)
    assert seen == [2, 3, 5, 6] and results[3].status == "failed"
    for result, other in zip(results[:3] + results[4:], alone[:3] + alone[4:], strict=True):
        np.testing.assert_array_equal(result.model(1), other.model(1))
        np.testing.assert_array_equal(result.losses, other.losses)

    def interrupt(n_done):
        raise KeyboardInterrupt

    status = [r.status for r in deblend_many(blends, progress=interrupt, **given)]
    assert status[:2] == [r.status for r in alone[:2]] and status[-1] == "interrupted"


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


def test_progress_true_tells_of_all(device, capsys):
    deblend_many([blend(), blend()], device=device, progress=True)
    assert "2 of 2 blends" in capsys.readouterr().err
