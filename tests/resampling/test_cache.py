"""Operators made once for each geometry: repeated requests cost nothing, old ones are dropped."""

import gc
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import BLURRED, SHAPE, SHARP, blend, frame, grids

from clresample.deblending.batch import deblend
from clresample.deblending.settings import Settings
from clresample.resampling import cache as cache_module
from clresample.resampling.cache import OperatorCache, cached_resampler, default_cache
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


@pytest.fixture(autouse=True)
def emptied():
    """No operators from other tests, and none for them."""
    default_cache().clear()
    yield
    default_cache().clear()


def make(device, *, home=None, grid=None, psf=SHARP, dtype=np.float32, **given):
    return cached_resampler(
        home or frame(), grid or grids()[0], psf, dtype=dtype, device=device, **given
    )


def test_the_same_geometry_is_the_same_operator(device):
    first = make(device)
    again = PSF(SHARP.images.copy()), Grid.flat(SHAPE, 0.1), frame()
    assert make(device, psf=again[0], grid=again[1], home=again[2]) is first
    assert (default_cache().n_plans, default_cache().n_operators) == (1, 1)


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
    with pytest.raises(ValueError, match="private=True"):
        first.shift = (1.0, 0.5)
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


def test_a_second_fit_of_a_geometry_makes_no_plan(device, monkeypatch):
    made, make_plan = [], cache_module.make_resampling_plan
    monkeypatch.setattr(
        cache_module, "make_resampling_plan", lambda *a, **k: made.append(a) or make_plan(*a, **k)
    )
    given = {"settings": Settings(max_iter=2), "device": device}
    for seed in (0, 1):
        b = blend(seed=seed)
        deblend(b.observations, b.sources, frame=b.frame, **given)
        assert len(made) == default_cache().n_operators == 2
    shifted = Settings(max_iter=2, fit_shifts=True)  # operators of its own, on the same plans
    deblend(b.observations, b.sources, frame=b.frame, settings=shifted, device=device)
    assert len(made) == default_cache().n_operators == 2


def test_a_cache_of_the_caller_s_own(device):
    mine, other = OperatorCache(), OperatorCache()
    op = make(device, cache=mine)
    assert make(device, cache=mine) is op
    assert op is not make(device, cache=other) is not make(device)
    assert mine.n_plans == mine.n_operators == default_cache().n_operators == 1
    mine.clear()
    assert make(device, cache=mine) is not op


def test_what_was_asked_for_longest_ago_goes_first(device):
    first = make(device)
    room = OperatorCache(plan_bytes=5 * first.plans[0].n_bytes // 2, device_bytes=first.n_bytes)
    psfs = [PSF.gaussian(0.9 + 1e-3 * i, n_pixels=19) for i in range(3)]
    a, b = (make(device, psf=psf, cache=room) for psf in psfs[:2])
    assert (room.n_plans, room.n_operators) == (2, 1)
    assert make(device, psf=psfs[1], cache=room) is b
    again = make(device, psf=psfs[0], cache=room)
    assert again is not a and again.plans[0] is a.plans[0]
    make(device, psf=psfs[2], cache=room)
    assert make(device, psf=psfs[0], cache=room).plans[0] is a.plans[0]
    assert make(device, psf=psfs[1], cache=room).plans[0] is not b.plans[0]
    # one that exceeds the bound by itself is kept all the same
    tiny = OperatorCache(plan_bytes=0, device_bytes=0)
    assert make(device, cache=tiny) is make(device, cache=tiny)


def test_operators_count_what_they_hold_on_the_device(device):
    before = device.in_use
    op = make(device)
    assert 0.3 < (device.in_use - before) / op.n_bytes < 2
    small = op.n_bytes
    op(np.zeros((64, *op.shape_in)))
    assert op.n_bytes > small + 64 * np.prod(op.shape_in) * op.dtype.itemsize
    assert 0.3 < (device.in_use - before) / op.n_bytes < 2


def test_what_entries_have_grown_by_is_found_out():
    """Not at once, but as soon as a tenth of the entries is new; each is asked a few times."""
    asked, store = [], cache_module._LRUStore(1000)

    class Entry:
        size = 10

        @property
        def n_bytes(self):
            asked.append(self)
            return self.size

    first = [store.find(i, Entry) for i in range(50)]
    assert len(asked) < 50 * (2 + 1 / cache_module.GROWTH) and len(store) == 50
    for entry in first:
        entry.size = 100
    for i in range(50, 56):
        store.find(i, Entry)
    assert len(store) <= 16 and store.find(55, None) is not first[-1]


@pytest.mark.counts_memory
def test_caches_are_bounded(device, monkeypatch):
    """More geometries than are kept: the device's memory stops growing."""
    monkeypatch.setattr(
        cache_module,
        "make_resampling_plan",
        lambda *a, **k: SimpleNamespace(n_bytes=100, mapping=None),
    )
    monkeypatch.setattr(
        cache_module.Resampler,
        "from_plans",
        lambda *a, **k: SimpleNamespace(n_bytes=4000, memory=device.empty(1000, np.float32)),
    )
    small, held = OperatorCache(plan_bytes=3000, device_bytes=40_000), []
    for i in range(60):
        make(device, home=frame(), psf=PSF.gaussian(0.9 + 1e-6 * i, n_pixels=11), cache=small)
        if i % 20 == 19:
            gc.collect()
            held.append(device.in_use)
    assert (small.n_plans, small.n_operators) == (30, 10)
    assert len(set(held)) == 1
