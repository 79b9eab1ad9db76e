"""Rules of a fit on its way, each alone: when it ends, what shares a group, what is too much."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes

from clresample.deblending import batch, fit as fit_module
from clresample.deblending.batch import _BatchRunner
from clresample.deblending.blend import Blend, Failure
from clresample.deblending.ended import Ended
from clresample.deblending.fit import Fit, data_bytes
from clresample.deblending.settings import Settings
from clresample.deblending.solver.scene import Scene
from clresample.paper.run import DIVERGENCE_RATIO, PATIENCE, stop_reason
from clresample.sky.sources import ExtendedSource, SourceWarning


def test_when_a_fit_ends():
    """After fifteen iterations in which the best loss fell by less than the part; ten times the
    best one is a divergence, as is NaN among the new losses alone."""
    assert (PATIENCE, DIVERGENCE_RATIO) == (15, 10)
    flat = [100.0] * 16
    assert stop_reason(flat[:15], 5, 1e-3) is None and stop_reason(flat, 5, 1e-3) == "converged"
    assert stop_reason([100.0] + [99.91] * 15, 5, 1e-3) == "converged"
    assert stop_reason([100.0] + [99.89] * 15, 5, 1e-3) is None
    assert stop_reason([50.0] + flat, 5, 1e-3) == "converged"  # it fell no further
    assert stop_reason([1.0, 9.9], 1, 1e-3) is None
    assert stop_reason([1.0, 10.1], 1, 1e-3) == "diverged"
    assert stop_reason([np.nan, 1.0, 1.0], 2, 1e-3) is None
    assert stop_reason([1.0, np.nan, 1.0], 2, 1e-3) == "diverged"
    assert stop_reason([1.0, np.inf], 1, 1e-3) == "diverged"


def test_sources_outside_the_frame_are_named():
    home = scenes.frame()
    inside, messages = fit_module._inside(home, np.array([(3.0, 4.0), (30.0, 4.0)]))
    assert inside.tolist() == [True, False] and len(messages) == 1
    assert messages[0].startswith("source 1 at [30.") and "(30, 36)" in messages[0]
    with pytest.raises(ValueError, match=r"none of the 2 sources lies inside .* \(30, 36\)"):
        fit_module._inside(home, np.array([(-3.0, 4.0), (30.0, 4.0)]))
    assert fit_module._dark_message(3, (1.26, 4.0)) == (
        "source 3 at (y, x) = (1.3, 4.0) [px] in the model frame lies far from any light: no image "
        "shows 3 sigma there or beside it"
    )


@pytest.mark.parametrize("fit_shifts", [False, True])
@pytest.mark.parametrize("shifts", [None, ((0, 0), (0, 0.4)), ((0, 0), (0.2, -0.3))])
def test_shifts_that_are_known_are_taken_by_operators_of_ones_own(device, shifts, fit_shifts):
    """Others share theirs."""
    given = scenes.blend()
    given = Blend(given.observations, given.sources, given.frame, shifts)
    one, other = (
        Fit(given, Settings(fit_shifts=fit_shifts), device, np.float32, pad=1) for _ in range(2)
    )
    np.testing.assert_array_equal(one.shifts, np.zeros((2, 2)) if shifts is None else shifts)
    shared = not fit_shifts and not np.any(one.shifts)
    assert [a.op is b.op for a, b in zip(one.views, other.views, strict=True)] == [shared] * 2
    moved, refused = one.shifts + [(0, 0), (0.1, 0.1)], pytest.raises(ValueError, match="shift is")
    with refused if shared else contextlib.nullcontext():
        one.shift(moved)
    assert np.array_equal(one.shifts, other.shifts) == shared


def test_frames_are_padded_to_multiples():
    home = scenes.frame()
    assert fit_module._padded_frame(home, 1) is home and fit_module._padded_frame(home, 6) is home
    padded = fit_module._padded_frame(home, 16)
    assert padded.shape == (32, 48) and padded.psf is home.psf
    np.testing.assert_allclose(padded.grid.sky(3, 4), home.grid.sky(3, 4), atol=1e-12)


def test_memory_of_a_fits_images():
    """Two of the model and four of the observation for each band, of 8 bytes."""
    ops = [
        SimpleNamespace(op=SimpleNamespace(shape_in=(c, 10, 12), shape_out=(c, 5, 7)))
        for c in (1, 3)
    ]
    assert data_bytes(SimpleNamespace(views=ops)) == 8 * 4 * (2 * 120 + 4 * 35)


def fits(n, monkeypatch, *, sources=1, n_bytes=10, memory=1000, signatures=None, n_scenes=50):
    """Sizes of the groups of n fits that are no more than numbers."""
    signatures = signatures or [0] * n
    made = iter(range(n))

    def one(*_given, **_more):
        k = next(made)
        return SimpleNamespace(signature=signatures[k], fitted=range(sources), number=k)

    monkeypatch.setattr(batch, "Fit", one)
    monkeypatch.setattr(batch, "data_bytes", lambda _: n_bytes)
    monkeypatch.setattr(batch, "check_instance", lambda *_: None)
    many = object.__new__(_BatchRunner)
    many.blends, many.done, many.memory = [None] * n, [None] * n, memory
    many.settings = many.device = many.dtype = many.pad = None
    many.tuning = SimpleNamespace(n_scenes=n_scenes, start_sources=500)
    many._begun = lambda group: [fit.number for _, fit in group]
    return list(many._groups())


def test_memory_of_a_scene():
    """Two models and four observed images a channel, twelve arrays a box, of eight bytes each."""
    ops = [
        SimpleNamespace(shape_in=(1, 4, 5), shape_out=(2, 3, 3)),
        SimpleNamespace(shape_in=(2, 4, 5), shape_out=(2, 6, 7)),
    ]
    one = SimpleNamespace(ops=ops, profile=[np.zeros((3, 3)), np.zeros((2, 5))])
    wanted = 8 * (2 * (20 + 40) + 4 * (18 + 84) + 12 * 19)
    assert Scene.n_bytes.fget(one) == wanted


def test_groups_fill_up():
    """To the scenes of a batch, to the memory, to 500 sources; what is left comes at the end."""
    with pytest.MonkeyPatch.context() as patch:
        assert fits(7, patch, n_scenes=3) == [[0, 1, 2], [3, 4, 5], [6]]
        assert fits(5, patch, n_bytes=250) == [[0, 1, 2, 3], [4]]  # one more would be too much
        assert fits(3, patch, n_bytes=251) == [[0, 1, 2]]
        assert fits(4, patch, n_bytes=334) == [[0, 1], [2, 3]]
        assert fits(3, patch, n_bytes=2000) == [[0], [1], [2]]
        assert fits(5, patch, sources=250) == [[0, 1], [2, 3], [4]]
        assert fits(4, patch, sources=249) == [[0, 1, 2], [3]]
        patch.setattr(batch, "MAX_SOURCES", 9)
        assert fits(7, patch, sources=3) == [[0, 1, 2], [3, 4, 5], [6]]
        assert fits(4, patch, sources=4) == [[0, 1], [2, 3]]
        kinds = [0, 1, 0, 1, 0]
        assert sorted(fits(5, patch, signatures=kinds, n_scenes=2)) == [[0, 2], [1, 3], [4]]


@pytest.mark.parametrize(
    "sizes, parts",
    [
        ([40, 60, 1], [[40, 60], [1]]),
        ([101, 5], [[101], [5]]),
        ([5, 101, 5], [[5], [101], [5]]),
        ([30, 30, 30, 30], [[30, 30, 30], [30]]),
        ([], []),
    ],
)
def test_parts_fit_into_the_memory(monkeypatch, sizes, parts):
    """Exactly the memory fits; what is larger by itself is tried by itself."""
    monkeypatch.setattr(batch, "scene_bytes", lambda fit: fit)
    many = object.__new__(_BatchRunner)
    many.memory = 100
    found = [[size for _, size in part] for part in many._parts(list(enumerate(sizes)))]
    assert found == parts


def test_what_a_failure_says():
    assert batch._failure("b", ValueError("no")) == Failure("b", Ended.FAILED, "no", ValueError)
    assert batch._failure("b", KeyError("no")).reason == "KeyError: 'no'"
    assert not Failure("b", Ended.FAILED).converged
    with pytest.raises(ValueError, match="blends is 3 .int., must be a sequence"):
        batch._listed("blends", 3)
    for n, words in ((1, "1 source position"), (2, "2 source positions")):
        with pytest.warns(SourceWarning, match=f"{words} here: see Result"):
            batch._warn_dark([np.arange(n)], " here")


def test_sizes_of_blends_are_told_apart():
    given = scenes.blend()
    sizes = batch._sizes(given)
    assert sizes == (((1, 30, 36), (2, 15, 18)), (30, 36))
    assert batch._sizes(Blend(given.observations, given.sources)) == (sizes[0], None)
    assert batch._sizes(3) is None
    assert batch._sizes(Blend(given.observations, (3,))) is None


def test_blends_of_one_size_keep_it_and_others_share_one(monkeypatch):
    """Failures to be, which have no size, pad nobody."""
    pads, small, large = [], scenes.blend(), scenes.blend(shape=(32, 37))

    def fitted(blends, *, pad, **_):
        pads.append(pad)
        return [(Failure(b, Ended.FAILED, "not asked"), ((), ())) for b in blends]

    monkeypatch.setattr(batch, "_fit_all", fitted)
    monkeypatch.setattr(batch, "get_device", lambda device: device)
    for blends in ([small], [small, small], [small, 3], [small, large], []):
        batch.deblend_many(blends, device="any")
    assert pads == [1, 1, 1, batch.PAD_PX, 1]


def test_work_is_bounded_before_it_begins():
    given = scenes.blend()
    home = SimpleNamespace(shape=(4096, 4097))
    with pytest.raises(ValueError, match=r"4096 x 4097 pixels, more than the 16777216 of one fit"):
        given._check_work(home)
    seen = [np.count_nonzero(o.weights[0]) for o in given.observations]
    many = Blend(given.observations, (ExtendedSource(position_px=(3, 3)),) * (max(seen) + 1))
    with pytest.raises(
        ValueError, match=rf"{max(seen) + 1} components, but .* than {max(seen)} pixels"
    ):
        many._check_work(given.frame)
    Blend(given.observations, many.sources[1:])._check_work(given.frame)
    weights = np.zeros((2, 60, 60))
    weights[1] = 1  # one channel sees enough
    half = SimpleNamespace(weights=weights, data=weights)
    Blend((half,), many.sources)._check_work(given.frame)
    dot = np.zeros((1, 60, 60))
    one = SimpleNamespace(weights=dot, data=dot)
    Blend((one,), many.sources)._check_work(given.frame)  # nothing is seen: nothing is fitted
    dot[0, 5, 6] = 1
    with pytest.raises(ValueError, match=r"2 components, but .* than 1 pixels"):
        Blend((one,), many.sources[:2])._check_work(given.frame)
    two = ExtendedSource(position_px=(3, 3), n_components=2)
    wide = SimpleNamespace(weights=np.ones((1, 60, 60)), data=np.zeros((1, 60, 60)))
    with pytest.raises(ValueError, match=r"1001 sources with 2002 components .* at most 2000 comp"):
        Blend((wide,), (two,) * 1001)._check_work(given.frame)
    Blend((wide,), (two,) * 1000)._check_work(given.frame)
    large = SimpleNamespace(shape=(2048, 2048))  # 60 boxes of 256 x 256 at 40 bytes and so on
    n_bytes = 40 * 1900 * 256**2 + 100 * (2048**2 + 3600)
    assert n_bytes < 8 << 30
    Blend((wide,), (two,) * 950)._check_work(large)
    big = SimpleNamespace(weights=np.ones((1, 60, 60)), data=np.zeros((1, 6000, 6000)))
    gib = (40 * 1900 * 256**2 + 100 * (2048**2 + 36e6)) / 2**30
    with pytest.raises(
        ValueError, match=rf"need {gib:.3g} GiB in one fit, must be at most .* 8 GiB"
    ):
        Blend((big,), (two,) * 950)._check_work(large)
