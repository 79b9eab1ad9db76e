"""Starts of second fits, on fits made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.profiles import (
    FixedProfile,
    GalaxyProfile,
    StarProfile,
)
from clresample.deblending.refit import two_component_start as second
from clresample.deblending.refit.colour_gradient import GradientTest
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.structure import coarse_count
from clresample.deblending.solver.scene import State, StructureState
from clresample.deblending.start import first_scene
from clresample.deblending.start.profile_start import StartingPoint, StartInput
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource


def test_a_second_fit_goes_on_where_the_first_has_ended():
    """A core begins on its profile, with the strengths of what it is beside; all else where it was
    left."""
    rng, prior = (
        np.random.default_rng(8),
        MultiscalePrior(scales_px=(1.0, 2.0), strengths=(0.1, 0.2)),
    )

    def coefficients(shape):
        return [rng.normal(size=[coarse_count(n, step) for n in shape]) for step in prior.steps]

    def state(shapes, learned=None):
        n = len(shapes)
        morph = [rng.random(shape) for shape in shapes]
        return State(morph, rng.random((n, 2)), rng.random(2), learned=learned)

    shapes = (4, 5), (6, 7), (3, 3)
    known = StructureState([coefficients(s) for s in shapes], rng.random((3, 2)), np.arange(3) == 1)
    end, chosen = state(shapes, known), np.array([1])
    first = SimpleNamespace(state=end, settings=SimpleNamespace(prior=prior))
    boxes, kept = ((4, 5), (6, 7), (7, 5), (3, 3)), {0: 0, 1: 1, 3: 2}
    begin = state(boxes)
    found = second._going_on(begin, first, *second._cores(3, chosen))
    for k, box in enumerate(boxes):
        own = found.learned.structure[k]
        if k in kept:
            np.testing.assert_array_equal(found.morph[k], end.morph[kept[k]])
            assert own is known.structure[kept[k]]
            continue
        assert found.morph[k] is begin.morph[k]
        assert not any(part.any() for part in own)
        for part, step in zip(own, prior.steps, strict=True):
            assert part.shape == tuple(coarse_count(n, step) for n in box)
    np.testing.assert_array_equal(found.learned.strengths, known.strengths[[0, 1, 1, 2]])
    assert found.learned.clear.tolist() == [False, True, True, False]


def test_a_core_begins_beside_each_component_in_question():
    """With half its area, its axes and its wings: nearly its square; all else stays."""
    home = Frame(Grid.flat((40, 44), 0.1), PSF.gaussian(0.3, n_pixels=11))
    shape, theta = GalaxyProfile(home), np.array([1.2, 0.2, -0.1, 3.0])
    position = np.array([[20.3, 21.6], [9.0, 9.0]])
    drawn = shape.draw(theta, position[0])[0]
    begin = StartingPoint(
        source=np.array([1, 0]),
        positions=position,
        undetected=np.zeros(2, bool),
        shapes=["other", shape],
        thetas=["its", theta],
        drawn_positions=position[::-1],
        peaks=np.array([0.5, drawn.max()]),
        spectra=np.array([[1.0, 2.0], [4.0, 5.0]]),
        sky=np.zeros(2),
        spectrum_curvature=np.array([[1.0, 1.0], [2.0, 2.0]]),
    )
    asked = GradientTest(np.array([0, 1]), np.array([0.0, 9.0]), np.array([[7.0] * 2, [8.0] * 2]))
    found = second._with_cores(SimpleNamespace(start=begin, frame=home), asked)
    assert found.source.tolist() == [1, 0, 0] and found.shapes == ["other", shape, shape]
    assert found.thetas[0] == "its" and found.thetas[1] is theta and theta[0] == 1.2
    np.testing.assert_allclose(found.thetas[2], [1.2 - np.log(2) / 2, 0.2, -0.1, 3.0])
    np.testing.assert_array_equal(found.drawn_positions, position[[1, 0, 0]])
    np.testing.assert_array_equal(found.spectra, begin.spectra[[0, 1, 1]])
    assert found.spectrum_curvature.tolist() == [
        [1] * 2,
        [2] * 2,
        [8] * 2,
    ] and begin.spectrum_curvature.shape == (2, 2)
    core = found.drawn(2, (0, 0), home.shape)
    assert core.max() == pytest.approx(1)
    assert abs(core - (drawn / drawn.max()) ** 2).max() < 0.06


def test_of_three_starts_the_one_that_fits_best_is_taken(monkeypatch):
    """Of each scene; with the best spectra and sky, kept from then on."""
    chi2, state = [9.0, 2.0, 5.0], State([], np.zeros((2, 3)), np.zeros(3))
    numbers = range(3), (2, 0, 1)
    starts, others = ([SimpleNamespace(name=k, state=state) for k in own] for own in numbers)
    monkeypatch.setattr(first_scene, "model_of", lambda one: one.name)
    monkeypatch.setattr(
        first_scene,
        "solve_models",
        lambda names, fit_sky: [(np.full((2, 3), k), np.full(3, -k), chi2[k]) for k in names],
    )
    best, other = first_scene.best_starts([starts, others], True)
    assert best is starts[1] and other is others[2]
    assert (best.state.spectra == 1).all() and (best.state.sky == -1).all()
    n_kept = np.array([[0.0, 2, 0], [0, 0, 4]])  # structure that the best ones keep
    best, other = first_scene.best_starts([starts, others], True, n_kept)
    assert best is starts[2] and other is others[0]


def test_scenes_with_clear_gradients_begin_anew(monkeypatch):
    """They alone; each of its two starts from what it should be made of."""

    def clear(*which):
        return SimpleNamespace(significant=np.array(which, int))

    def begun(name, estimate=()):
        return StartingPoint([0], [0], [], [], [name], 0, 0, 0, 0, 0, flux_estimate=estimate)

    asked = [None, clear(1), clear(), clear(0, 2)]
    settings, tols = SimpleNamespace(fit_sky=True, start_tol=25.0), []
    found = SimpleNamespace(n_effective=np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))
    given = {"settings": settings, "strength_estimates": found}
    fits = [SimpleNamespace(name=i, start=[i] * 3, **given) for i in range(4)]
    kept = []
    monkeypatch.setattr(second, "run_gradient_tests", lambda fits: asked)
    monkeypatch.setattr(second, "_together", lambda fit, which: f"all {fit.name} {which.tolist()}")
    monkeypatch.setattr(
        second,
        "fit_start_profiles",
        lambda patches, fit_sky=False, *, tol: tols.append(tol) or patches,
    )
    monkeypatch.setattr(
        second, "_as_before", lambda whole, begin, _: begun(f"{whole} as {begin[0]}", "zero")
    )
    monkeypatch.setattr(
        second, "_with_cores", lambda fit, one: begun(f"cores {one.significant.tolist()}")
    )
    monkeypatch.setattr(
        second, "_again", lambda fit, point: SimpleNamespace(point=point, state="new")
    )
    monkeypatch.setattr(
        second,
        "_going_on",
        lambda state, first, before, new: (first.name, before.tolist(), new.tolist()),
    )
    monkeypatch.setattr(
        second, "best_starts", lambda starts, fit_sky, n_kept: kept.append(n_kept) or starts
    )
    again = second.start_refits(fits)
    np.testing.assert_array_equal(kept[0], [[0, 21], [0, 21]])  # structure that is kept
    assert {i: [(one.point.thetas, one.state) for one in two] for i, two in again.items()} == {
        1: [
            (["all 1 [1] as 1"], "new"),
            (["cores [1]"], (1, [0, 1, 1, 2], [False, False, True, False])),
        ],
        3: [
            (["all 3 [0, 2] as 3"], "new"),
            (["cores [0, 2]"], (3, [0, 0, 1, 2, 2], [False, True, False, False, True])),
        ],
    }
    assert {one.point.flux_estimate for two in again.values() for one in two} == {"zero"}
    asked[1] = asked[3] = None
    assert second.start_refits(fits) == {} and tols == [25.0]


def test_the_other_start_takes_galaxies_over():
    """Given profiles, stars and galaxies of two components are fitted as ever."""
    frame = SimpleNamespace(shape=(6, 7))
    one, two = object.__new__(GalaxyProfile), object.__new__(GalaxyProfile)
    shapes = [one, StarProfile.__new__(StarProfile), two, two, FixedProfile(np.ones((6, 7))), one]
    source = np.array([0, 1, 2, 2, 3, 4])
    drawn = np.random.default_rng(9).random((6, 7))
    thetas = np.arange(24.0).reshape(6, 4)
    begin = SimpleNamespace(
        source=source, shapes=shapes, drawn=lambda i, low, size: drawn + i, thetas=list(thetas)
    )
    place = {"position_px": (1.0, 2.0)}
    sources = [
        ExtendedSource(**place),
        PointSource(**place),
        ExtendedSource(**place, n_components=2),
        ExtendedSource(**place, profile=np.ones((6, 7))),
        ExtendedSource(**place),
    ]
    patch = StartInput(frame, sources, np.ones((5, 2)), ["view"])
    found = second._together(SimpleNamespace(start=begin, patch=patch, frame=frame), np.array([5]))
    assert found.sources[1:4] == sources[1:4] and found.views == ["view"]
    assert found.sources[4].n_components == 2 and found.sources[4].profile is None
    np.testing.assert_array_equal(found.sources[0].profile, drawn)
    assert patch.sources[0].profile is None
    np.testing.assert_array_equal(found.thetas[2], thetas[2:4])  # as the first fit had them
    np.testing.assert_array_equal(np.mean(found.thetas[4], axis=0), thetas[5])


def test_what_was_taken_over_has_its_first_shape_again():
    one, star, own = (
        object.__new__(GalaxyProfile),
        StarProfile.__new__(StarProfile),
        FixedProfile(np.ones((3, 3))),
    )
    held, new = FixedProfile(np.ones((3, 3))), object.__new__(GalaxyProfile)

    def point(shapes, first):
        n = len(shapes)
        numbers = {
            name: np.arange(n) + first
            for name in ("drawn_positions", "peaks", "spectra", "spectrum_curvature")
        }
        rest = {"source": np.arange(n), "positions": 0, "undetected": 0, "sky": 0}
        rest["flux_estimate"] = rest["flux_doubt"] = np.full((4, 1), first + 1.0)
        thetas = [first + i for i in range(n)]
        return StartingPoint(shapes=shapes, thetas=thetas, **numbers, **rest)

    begin = point([one, star, one, own], 0)
    whole = point([held, star, new, new, own], 10)
    found = second._as_before(whole, begin, np.array([2]))
    assert found.shapes == [one, star, new, new, own]
    assert found.thetas == [0, 11, 12, 13, 3]
    assert found.drawn_positions.tolist() == found.peaks.tolist() == [0, 11, 12, 13, 3]
    assert found.spectra.tolist() == found.spectrum_curvature.tolist() == [10, 11, 12, 13, 14]
    assert whole.shapes[0] is held and whole.peaks[0] == 10
    assert found.flux_estimate.ravel().tolist() == [1, 1, 0, 1]
    assert found.flux_doubt is begin.flux_doubt
