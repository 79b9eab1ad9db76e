"""Operators made once for each geometry: asked again they cost nothing, and they are not kept for
ever."""

import gc
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import BLURRED, SHAPE, SHARP, blend, frame, grids

from clresample.deblending.batch import deblend
from clresample.deblending.settings import Settings
from clresample.resampling import cache as operators
from clresample.resampling.cache import N_OPERATORS, N_PLANS, cached_resampler
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


@pytest.fixture(autouse=True)
def emptied():
    """No operators from other tests, and none for them."""
    for cache in (operators._plan, operators._operator):
        cache.cache_clear()
    yield
    for cache in (operators._plan, operators._operator):
        cache.cache_clear()


def make(device, *, home=None, grid=None, psf=SHARP, dtype=np.float32, **given):
    return cached_resampler(
        home or frame(), grid or grids()[0], psf, dtype=dtype, device=device, **given
    )


def test_the_same_geometry_is_the_same_operator(device):
    first = make(device)
    again = PSF(SHARP.images.copy()), Grid.flat(SHAPE, 0.1), frame()
    assert make(device, psf=again[0], grid=again[1], home=again[2]) is first
    assert operators._plan.cache_info().misses == 1


@pytest.mark.parametrize(
    "other",
    [
        {"psf": PSF.gaussian(0.91, n_pixels=19)},
        {"psf": PSF(SHARP.images, center=(9.1, 9.0))},
        {"psf": PSF(SHARP.images, spacing=0.9)},
        {"grid": Grid.flat(SHAPE, 0.1, center_arcsec=(0.01, 0))},
        {"grid": Grid.flat(SHAPE, 0.1, angle_deg=1)},
        {"home": Frame(Grid.flat(SHAPE, 0.1), PSF.gaussian(0.9, n_pixels=19))},
        {"extent": (20, 36)},
    ],
    ids=lambda other: "-".join(other),
)
def test_another_geometry_is_another_operator(device, other):
    first, second = make(device), make(device, **other)
    assert first is not second and first.plans[0] is not second.plans[0]


def test_types_and_private_operators(device):
    first = make(device)
    if device.has_fp64:
        assert make(device, dtype=np.float64).dtype == np.float64
    mine = make(device, private=True)
    assert mine is not first and mine.plans[0] is first.plans[0]
    mine.shift = (1.0, 0.5)
    assert not first.shift.any() and not make(device, private=True).shift.any()


def test_padding_keeps_the_frequencies_and_so_the_answer(device):
    """A frame padded with zeros sees what the frame sees, sharp edges and all."""
    small, wide = frame(), Frame(Grid.flat(SHAPE, 0.1).cutout(0, 0, (48, 48)), frame().psf)
    image = np.random.default_rng(0).random(SHAPE)
    padded = np.pad(image, [(0, 18), (0, 12)])
    for grid, psf in zip(grids(), (SHARP, BLURRED), strict=True):
        alone = make(device, home=small, grid=grid, psf=psf)
        op = make(device, home=wide, grid=grid, psf=psf, extent=SHAPE)
        there = alone.covered
        assert not (there & ~op.covered).any()
        # rounding of float32 sums, and the window of the lines of turned pixels
        np.testing.assert_allclose(
            op.render(padded)[:, there], alone.render(image)[:, there], rtol=0, atol=3e-6
        )
        bare = make(device, home=wide, grid=grid, psf=psf)
        assert np.abs(bare.render(padded) - alone.render(image))[:, there].max() > 3e-5


def test_a_second_fit_of_a_geometry_makes_no_plan(device):
    given = {"settings": Settings(max_iter=2), "device": device}
    for seed, made in ((0, 2), (1, 2)):
        b = blend(seed=seed)
        deblend(b.observations, b.sources, frame=b.frame, **given)
        assert operators._plan.cache_info().misses == made
        assert operators._operator.cache_info().misses == made
    shifted = Settings(max_iter=2, fit_shifts=True)  # operators of its own, on the same plans
    deblend(b.observations, b.sources, frame=b.frame, settings=shifted, device=device)
    assert operators._plan.cache_info().misses == 2


def test_caches_are_bounded(device, monkeypatch):
    """More geometries than are kept: the device's memory stops growing."""
    monkeypatch.setattr(operators, "make_plan", lambda *a, **k: None)
    monkeypatch.setattr(
        operators.Resampler,
        "from_plans",
        lambda *a, **k: SimpleNamespace(memory=device.empty(1000, np.float32)),
    )
    held = []
    for i in range(N_PLANS + 20):
        make(device, home=frame(), psf=PSF.gaussian(0.9 + 1e-6 * i, n_pixels=11))
        if i % 20 == 19:
            gc.collect()
            held.append(device.in_use)
    assert operators._plan.cache_info().currsize == N_PLANS
    assert operators._operator.cache_info().currsize == N_OPERATORS
    assert len(set(held[2:])) == 1
