"""Where a second fit begins, on fits made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.components import second
from clresample.deblending.components.gradients import Asked
from clresample.deblending.profiles import Galaxy, Given, Star
from clresample.deblending.rendered import Rendered
from clresample.deblending.solver.learned.prior import LearnedPrior
from clresample.deblending.solver.learned.structure import coarse
from clresample.deblending.solver.scene import Learned, State
from clresample.deblending.start.seen import Seen
from clresample.deblending.start.start import Patch, StartingPoint
from clresample.deblending.view import WhitenedView
from clresample.sky.sources import Extended, Point


def test_the_second_start_is_from_what_the_others_leave():
    """Their light and the sky are taken off the data, in every channel of each observation."""
    rng, shape = np.random.default_rng(6), (5, 4)
    spectra, sky = rng.uniform(1, 2, (3, 3)), np.array([0.5, -0.25, 0.125])
    parts, views, observed = [slice(0, 1), slice(1, 3)], [], []
    begin = SimpleNamespace(source=np.array([0, 2, 1]), positions=rng.uniform(0, 4, (3, 2)))
    for part in parts:
        images = rng.random((3, part.stop - part.start, *shape))
        observed.append(Rendered(images.shape, np.zeros((3, 2), int), list(images)))
        data, root = rng.normal(size=images.shape[1:]), np.ones(images.shape[1:])
        shares = rng.random((3, part.stop - part.start, 2))
        views.append(WhitenedView(None, None, None, None, root, data, shares))
    fit = SimpleNamespace(
        state=SimpleNamespace(spectra=spectra, sky=sky),
        scene=SimpleNamespace(channels=lambda: parts),
        start=begin,
        views=views,
        frame="home",
    )
    patch = second._alone(fit, Asked(np.array([1]), np.array([9.0]), observed))
    for view, own, images, part in zip(views, patch.views, observed, parts, strict=True):
        others = np.einsum("ic,icyx->cyx", spectra[[0, 2], part], np.asarray(images)[[0, 2]])
        np.testing.assert_allclose(own.data, view.data - others - sky[part, None, None])
        np.testing.assert_array_equal(own.shares, view.shares[[2]])
    (source,) = patch.sources
    assert source.n_components == 2 and patch.frame == "home"
    np.testing.assert_array_equal(patch.positions, begin.positions[[2]])
    np.testing.assert_array_equal(source.position_px, begin.positions[2])
    assert fit.state.spectra.all()  # the first fit's own stay


def test_the_second_fit_takes_the_place_of_the_chosen_components():
    """Two each, in the order of the sources."""

    def point(n, first):
        fields = {name: np.arange(n) + first for name in ("peaks", "spectra", "power", "places")}
        return fields | {"shapes": list("abcdef"[:n]), "thetas": [first] * n}

    others = {"positions": np.zeros((3, 2)), "dark": np.zeros(3, bool), "sky": np.zeros(1)}
    begin = StartingPoint(source=np.array([0, 2, 1]), **others, **point(3, 0))
    found = StartingPoint(source=np.array([0, 0, 1, 1]), **others, **point(4, 10))
    joined = second._joined(begin, found, np.array([2, 0]))
    assert joined.source.tolist() == [0, 0, 2, 1, 1]
    for name in ("peaks", "spectra", "power", "places"):
        assert getattr(joined, name).tolist() == [12, 13, 1, 10, 11]
    assert joined.shapes == list("cdbab") and joined.thetas == [10, 10, 0, 10, 10]


def test_a_second_fit_goes_on_where_the_first_has_ended():
    """Two components in place of one begin on their profiles, with its strengths; all else where it
    was left."""
    rng, prior = np.random.default_rng(8), LearnedPrior(scales_px=(1.0, 2.0), strengths=(0.1, 0.2))

    def coefficients(shape):
        return [rng.normal(size=[coarse(n, step) for n in shape]) for step in prior.steps]

    def state(shapes, learned=None):
        n = len(shapes)
        morph = [rng.random(shape) for shape in shapes]
        return State([0] * n, morph, rng.random((n, 2)), rng.random(2), learned=learned)

    shapes = (4, 5), (6, 7), (3, 3)
    known = Learned([coefficients(s) for s in shapes], rng.random((3, 2)), np.arange(3) == 1)
    end, begin = state(shapes, known), state(((4, 5), (8, 9), (7, 5), (3, 3)))
    first = SimpleNamespace(state=end, settings=SimpleNamespace(prior=prior))
    found = second._going_on(begin, first, np.array([1]))
    for k, i in ((0, 0), (3, 2)):
        np.testing.assert_array_equal(found.morph[k], end.morph[i])
        np.testing.assert_array_equal(found.spectra[k], end.spectra[i])
        assert found.learned.structure[k] is known.structure[i]
    for k in (1, 2):
        assert found.morph[k] is begin.morph[k]
        np.testing.assert_array_equal(found.spectra[k], begin.spectra[k])
        assert not any(part.any() for part in found.learned.structure[k])
    assert [part.shape for part in found.learned.structure[1]] == [(8, 9), (5, 5)]
    np.testing.assert_array_equal(found.learned.strengths, known.strengths[[0, 1, 1, 2]])
    assert found.learned.clear.tolist() == [False, True, True, False]
    np.testing.assert_array_equal(found.sky, end.sky)


def test_misfits_are_chi2_of_all_observations(monkeypatch):
    rng, views, observed = np.random.default_rng(5), [], []
    spectra, sky, wanted = rng.random((2, 3)), rng.random(3), 0.0
    parts = slice(0, 1), slice(1, 3)
    for part in parts:
        images = rng.random((2, part.stop - part.start, 4, 5))
        observed.append(Rendered(images.shape, np.zeros((2, 2), int), images))
        root, data = rng.random((2, *images.shape[1:]))
        views.append(SimpleNamespace(root=root, data=data))
        model = np.einsum("ic,icyx->cyx", spectra[:, part], images) + sky[part, None, None]
        wanted += (root**2 * (data - model) ** 2).sum()
    fit = SimpleNamespace(
        views=views,
        scene=SimpleNamespace(channels=lambda: parts),
        settings=SimpleNamespace(fit_sky=True),
    )
    seen = Seen(spectra, sky, None, tuple(observed), ())
    monkeypatch.setattr(second, "model_of", lambda one: one)
    monkeypatch.setattr(second, "see", lambda models, fit_sky: [seen] * len(models))
    assert second._misfits([fit, fit]) == pytest.approx([wanted, wanted])


def test_of_two_starts_the_one_that_fits_better_is_taken(monkeypatch):
    """Of scenes with clear gradients alone; only one of them goes on from the first fit."""

    def clear(*which):
        return SimpleNamespace(clear=np.array(which, int))

    asked = [None, clear(1), clear(), clear(0, 2)]
    settings = SimpleNamespace(fit_sky=True)
    fits = [SimpleNamespace(name=i, start=f"start {i}", settings=settings) for i in range(4)]
    monkeypatch.setattr(second, "ask", lambda fits: asked)
    monkeypatch.setattr(second, "_alone", lambda fit, one: f"alone {fit.name}")
    monkeypatch.setattr(second, "_together", lambda fit, which: f"all {fit.name} {which.tolist()}")
    monkeypatch.setattr(second, "start", lambda patches, fit_sky=False: patches)
    monkeypatch.setattr(second, "_joined", lambda begin, own, which: f"{own} in {begin}")
    monkeypatch.setattr(second, "_as_before", lambda whole, begin, which: f"{whole} as {begin}")
    monkeypatch.setattr(
        second, "_again", lambda fit, point: SimpleNamespace(point=point, state="new")
    )
    monkeypatch.setattr(
        second, "_going_on", lambda state, first, which: f"{state} from {first.name} {which}"
    )
    monkeypatch.setattr(second, "_misfits", lambda fits: [3.0, 2.0, 1.0, 4.0][: len(fits)])
    again = second._begun(fits)
    assert {i: (one.point, one.state) for i, one in again.items()} == {
        1: ("all 1 [1] as start 1", "new"),
        3: ("alone 3 in start 3", "new from 3 [0 2]"),
    }
    asked[1] = asked[3] = None
    assert second._begun(fits) == {}


def test_the_other_start_takes_galaxies_over():
    """Given profiles, stars and galaxies of two components are fitted as ever."""
    frame = SimpleNamespace(shape=(6, 7))
    one, two = object.__new__(Galaxy), object.__new__(Galaxy)
    shapes = [one, Star.__new__(Star), two, two, Given(np.ones((6, 7))), one]
    source = np.array([0, 1, 2, 2, 3, 4])
    drawn = np.random.default_rng(9).random((6, 7))
    begin = SimpleNamespace(source=source, shapes=shapes, drawn=lambda i, low, size: drawn + i)
    place = {"position_px": (1.0, 2.0)}
    sources = [
        Extended(**place),
        Point(**place),
        Extended(**place, n_components=2),
        Extended(**place, profile=np.ones((6, 7))),
        Extended(**place),
    ]
    patch = Patch(frame, sources, np.ones((5, 2)), ["view"])
    found = second._together(SimpleNamespace(start=begin, patch=patch, frame=frame), np.array([5]))
    assert found.sources[1:4] == sources[1:4] and found.views == ["view"]
    assert found.sources[4].n_components == 2 and found.sources[4].profile is None
    np.testing.assert_array_equal(found.sources[0].profile, drawn)
    assert patch.sources[0].profile is None


def test_what_was_taken_over_has_its_first_shape_again():
    one, star, own = object.__new__(Galaxy), Star.__new__(Star), Given(np.ones((3, 3)))
    held, new = Given(np.ones((3, 3))), object.__new__(Galaxy)

    def point(shapes, first):
        n = len(shapes)
        numbers = {name: np.arange(n) + first for name in ("places", "peaks", "spectra", "power")}
        rest = {"source": np.arange(n), "positions": 0, "dark": 0, "sky": 0}
        thetas = [first + i for i in range(n)]
        return StartingPoint(shapes=shapes, thetas=thetas, **numbers, **rest)

    begin = point([one, star, one, own], 0)
    whole = point([held, star, new, new, own], 10)
    found = second._as_before(whole, begin, np.array([2]))
    assert found.shapes == [one, star, new, new, own]
    assert found.thetas == [0, 11, 12, 13, 3]
    assert found.places.tolist() == found.peaks.tolist() == [0, 11, 12, 13, 3]
    assert found.spectra.tolist() == found.power.tolist() == [10, 11, 12, 13, 14]
    assert whole.shapes[0] is held and whole.peaks[0] == 10
