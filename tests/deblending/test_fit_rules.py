"""Rules of fits, in tables: their ends, groups and parts, failures, and limits of one fit."""

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from helpers import scenes

from clresample.deblending import batch, fit as fit_module
from clresample.deblending.batch import _BatchRunner
from clresample.deblending.blend import Blend, Failure
from clresample.deblending.ended import Ended
from clresample.deblending.fit import Fit, data_bytes
from clresample.deblending.settings import Settings
from clresample.deblending.solver.scene import Scene
from clresample.paper.run import DIVERGENCE_RATIO, PATIENCE, stop_reason
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.sources import ExtendedSource, SourceWarning

FLAT = [100.0] * 16


@pytest.mark.parametrize(
    "reason, runs",
    [
        (None, [(FLAT[:15], 5), ([100.0, *[99.89] * 15], 5), ([1.0, 9.9], 1), ([np.nan, 1, 1], 2)]),
        ("converged", [(FLAT, 5), ([100.0, *[99.91] * 15], 5), ([50.0, *FLAT], 5)]),
        ("diverged", [([1.0, 10.1], 1), ([1.0, np.nan, 1.0], 2), ([1.0, np.inf], 1)]),
    ],
)
def test_a_fit_ends_after_fifteen_flat_iterations_or_at_ten_times_its_best_loss(reason, runs):
    """NaN is a divergence among the new losses alone."""
    assert (PATIENCE, DIVERGENCE_RATIO) == (15, 10)
    assert [stop_reason(losses, n_new, 1e-3) for losses, n_new in runs] == [reason] * len(runs)


def test_sources_outside_the_frame_are_named():
    home = scenes.frame()
    inside, messages = fit_module._inside(home, np.array([(3.0, 4.0), (30.0, 4.0)]))
    assert inside.tolist() == [True, False] and len(messages) == 1
    assert (
        messages[0].startswith("a source lies outside the model frame: source 1 at (y, x) = (30.0,")
        and "(30, 36)" in messages[0]
    )
    with pytest.raises(ValueError, match=r"none of the 2 sources lies inside .* \(30, 36\)"):
        fit_module._inside(home, np.array([(-3.0, 4.0), (30.0, 4.0)]))
    assert fit_module._dark_message(3, (1.26, 4.0)) == (
        "a source lies far from any light: source 3 at (y, x) = (1.3, 4.0) [px] in the model "
        "frame; no image shows 3 sigma there or beside it"
    )


@pytest.mark.parametrize(
    "sky_deg, hint",
    [
        ((2.0, 150.0), True),  # no declination
        ((2.5, 12.3), True),  # one
        ((12.3, 3.5), False),
        (SkyCoord(2.5, 12.3, unit="deg"), False),  # has an order of its own
    ],
)
def test_swapped_coordinates_are_named(sky_deg, hint):
    ra = 150 if hint and sky_deg[1] == 150 else 12.3
    wcs = Grid.flat((30, 36), 0.2).to_wcs(ra_deg=ra, dec_deg=2.5)
    home = Frame(Grid.from_wcs(wcs, (30, 36)), scenes.SHARP)
    sources = (ExtendedSource(sky_deg=sky_deg),)
    with pytest.raises(ValueError, match="none of the 1 sources") as error:
        fit_module._inside(home, home.positions_of(sources), sources)
    assert ("must be (right ascension, declination)" in str(error.value)) is hint


def test_an_empty_list_of_sources_is_named():
    with pytest.raises(ValueError, match="sources is empty, at least one .* list sources"):
        replace(scenes.blend(), sources=()).resolve_frame()


def test_two_sources_of_one_name_are_refused():
    """A cutout by that name would be the first one's."""
    given, own = scenes.blend(), (replace(s, name="a") for s in scenes.blend().sources)
    with pytest.raises(ValueError, match="name 'a' is that of [0-9] sources, must be unique"):
        replace(given, sources=tuple(own)).check()


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


def test_memory_of_fits_and_scenes():
    """Of 8 bytes a number: two images of the model and seven of the observation for each band or
    channel, twelve arrays a box of a scene."""
    shapes = [((1, 10, 12), (1, 5, 7)), ((3, 10, 12), (3, 5, 7))]
    ops = [SimpleNamespace(shape_in=inside, shape_out=out) for inside, out in shapes]
    n_images = 8 * 4 * (2 * 120 + 7 * 35)
    assert data_bytes(SimpleNamespace(views=[SimpleNamespace(op=op) for op in ops])) == n_images
    one = SimpleNamespace(ops=ops, profile=[np.zeros((3, 3)), np.zeros((2, 5))])
    assert Scene.n_bytes.fget(one) == n_images + 8 * 12 * 19
    ops[0].shape_out = (2, 6, 7)
    assert Scene.n_bytes.fget(one) == n_images + 8 * (12 * 19 + 7 * (2 * 42 - 35))


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


@pytest.mark.parametrize(
    "n, given, groups",
    [
        (7, {"n_scenes": 3}, [[0, 1, 2], [3, 4, 5], [6]]),
        (5, {"n_bytes": 250}, [[0, 1, 2, 3], [4]]),  # one more would be too much
        (3, {"n_bytes": 251}, [[0, 1, 2]]),
        (4, {"n_bytes": 334}, [[0, 1], [2, 3]]),
        (3, {"n_bytes": 2000}, [[0], [1], [2]]),
        (5, {"sources": 250}, [[0, 1], [2, 3], [4]]),
        (4, {"sources": 249}, [[0, 1, 2], [3]]),
        (7, {"sources": 3, "most": 9}, [[0, 1, 2], [3, 4, 5], [6]]),
        (4, {"sources": 4, "most": 9}, [[0, 1], [2, 3]]),
        (5, {"signatures": [0, 1, 0, 1, 0], "n_scenes": 2}, [[0, 2], [1, 3], [4]]),
    ],
)
def test_groups_fill_up(n, given, groups, monkeypatch):
    """To the scenes of a batch, to the memory, to 500 sources; what is left comes at the end."""
    monkeypatch.setattr(batch, "MAX_SOURCES", given.pop("most", batch.MAX_SOURCES))
    assert sorted(fits(n, monkeypatch, **given)) == groups


@pytest.mark.parametrize(
    "sizes, parts",
    [
        ([40, 60, 1], [[40, 60], [1]]),
        ([40, 60, 41, 300, 10], [[40, 60], [41], [300], [10]]),
        ([101, 5], [[101], [5]]),
        ([5, 101, 5], [[5], [101], [5]]),
        ([30, 30, 30, 30], [[30, 30, 30], [30]]),
        ([], []),
    ],
)
def test_parts_fit_into_the_memory(monkeypatch, sizes, parts):
    """Exactly the memory fits; a scene that exceeds it goes alone."""
    monkeypatch.setattr(batch, "scene_bytes", lambda fit: fit)
    many = object.__new__(_BatchRunner)
    many.memory = 100
    found = [[size for _, size in part] for part in many._parts(list(enumerate(sizes)))]
    assert found == parts


def test_what_a_failure_says():
    assert batch._failure("b", ValueError("no")) == Failure("b", Ended.FAILED, "no", ValueError)
    assert batch._failure("b", KeyError("no")).reason == "KeyError: 'no'"
    assert not Failure("b", Ended.FAILED).converged
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


def seen(n_pixels, *, beside=(), data=60):
    """An observation of channels (60, 60) with so many pixels of weight in each."""
    weights = np.zeros((1 + len(beside), 60, 60))
    for channel, n in zip(weights, (n_pixels, *beside), strict=True):
        channel.flat[:n] = 1
    return SimpleNamespace(weights=weights, data=np.zeros((len(weights), data, data)))


ONE = ExtendedSource(position_px=(3, 3))
TWO = ExtendedSource(position_px=(3, 3), n_components=2)
GIB = (40 * 1900 * 256**2 + 100 * (2048**2 + 36e6)) / 2**30  # of the last case; 60 px: under 8


@pytest.mark.parametrize(
    "observation, sources, side, words",
    [
        (seen(9), [ONE], (4096, 4097), "4096 x 4097 pixels, more than the 16777216 of one fit"),
        (seen(9), [ONE], (4096, 4096), None),
        (seen(270), [ONE] * 271, (30, 36), "271 components, but .* than 270 pixels"),
        (seen(270), [ONE] * 270, (30, 36), None),
        (seen(0, beside=[3600]), [ONE] * 271, (30, 36), None),  # one channel suffices
        (seen(0), [ONE] * 271, (30, 36), None),  # nothing is fitted without data
        (seen(1), [ONE] * 2, (30, 36), "2 components, but .* than 1 pixels"),
        (seen(3600), [TWO] * 1001, (30, 36), "1001 sources with 2002 comp.* at most 2000 comp"),
        (seen(3600), [TWO] * 1000, (30, 36), None),
        (seen(3600), [TWO] * 950, (2048, 2048), None),
        (
            seen(3600, data=6000),
            [TWO] * 950,
            (2048, 2048),
            rf"need {GIB:.3g} GiB in one fit, must be at most .* 8 GiB",
        ),
    ],
)
def test_work_is_bounded_before_it_begins(observation, sources, side, words):
    one = Blend((observation,), tuple(sources))
    with pytest.raises(ValueError, match=words) if words else contextlib.nullcontext():
        one._check_work(SimpleNamespace(shape=side))
