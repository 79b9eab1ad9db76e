"""Results of a state made by hand: maxima of 1, units, uncovered channels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending import fit as room
from clresample.deblending.component_images import ComponentImages
from clresample.deblending.fit import Fit
from clresample.deblending.profiles import ComponentProfile
from clresample.deblending.solver.scene import StructureState

UNIT = np.array([2.0, 10.0, 0.5])
CHANNELS = slice(0, 1), slice(1, 3)
SHAPES = (6, 7), (5, 9)


def ended(noise=(None, "correlated")):
    """A fit of the components of sources 5, 5 and 3, the last of them dark all over."""
    rng = np.random.default_rng(0)
    morphs = [rng.uniform(0, m, (3 + m, 4)).astype(np.float32) for m in (2, 3)]
    morphs.append(np.zeros((2, 2), np.float32))
    observations, views = [], []
    for part, shape, n in zip(CHANNELS, SHAPES, noise, strict=True):
        data = np.zeros((part.stop - part.start, *shape))
        covered = rng.random(shape) > 0.3
        observations.append(SimpleNamespace(data=data, noise=n))
        views.append(SimpleNamespace(covered=covered))
    learned = StructureState(
        [[rng.random((2, k))] for k in (1, 2, 3)], rng.random((3, 1)), np.arange(3) > 0
    )
    fit = SimpleNamespace(
        blend=SimpleNamespace(observations=tuple(observations)),
        frame="frame", geometry="home", sources=tuple("abcdef"), views=views, unit=UNIT,
        sky_level=np.array([0.5, -0.25, 2.0]),
        padded=SimpleNamespace(shape=(24, 32)),
        fitted=np.array([3, 5]),
        start=SimpleNamespace(
            source=np.array([1, 1, 0]), thetas=["p", "q", "r"], shapes=[ComponentProfile()] * 3
        ),
        scene=SimpleNamespace(
            origin=np.array([(1, 2), (3, 4), (5, 6)]), fixed=np.array([False, False, True])
        ),
        state=SimpleNamespace(morph=morphs, learned=learned),
        shifts=np.array([(0, 0), (0.1, 0.2)]), losses=[3.0, 2.0], status="converged",
        messages=["one"], seconds={"result": 1.0, "fit": 2.0},
        settings=SimpleNamespace(fit_sky="whether", psf_error=0.02), unlisted=((0, 1, 2),),
    )  # fmt: skip
    fit.note_seconds = lambda what, s: fit.seconds.update({what: fit.seconds[what] + s})
    return fit


def seen_of(fit, bare):
    """Spectra, sky, covariance, and images in windows of which some end outside."""
    rng = np.random.default_rng(1)

    def some(k):
        n = CHANNELS[k].stop - CHANNELS[k].start
        low = np.array([(0, 0), (2, 3), (1, 1)])
        return ComponentImages((3, n, *SHAPES[k]), low, [rng.random((n, 3, 4)) for _ in range(3)])

    return SimpleNamespace(
        spectra=rng.random((3, 3)), sky=rng.random(3), covariance=rng.random((3, 3, 3)),
        observed=(some(0), some(1)), unfiltered_views=(None, some(1) if bare else None),
    )  # fmt: skip


@pytest.mark.parametrize("bare", [False, True])
def test_results_are_in_counts_and_have_maxima_of_1(monkeypatch, bare):
    """Observations are shown as they were taken, where that is not as they were fitted."""
    fit = ended()
    seen, asked = seen_of(fit, bare), []

    def with_errors(*given):
        asked.append(given)
        return replace(given[1], errors="errors")

    monkeypatch.setattr(room, "with_errors", with_errors)
    found = Fit.result(fit, seen)
    assert [c.source for c in found.components] == [5, 5, 3]
    assert [c.origin for c in found.components] == [(1, 2), (3, 4), (5, 6)]
    peaks = [fit.state.morph[0].max(), fit.state.morph[1].max(), 1]
    for c, m, peak, a in zip(found.components, fit.state.morph, peaks, seen.spectra, strict=True):
        np.testing.assert_array_equal(c.morphology, m.astype(np.float64) / peak)
        np.testing.assert_array_equal(c.spectrum, a * UNIT)
    assert found.components[0].morphology.max() == 1
    ((of, bare_result, given, same),) = asked
    assert of is fit and bare_result.components == found.components and same is seen
    np.testing.assert_array_equal(given, peaks)
    np.testing.assert_array_equal(found.sky, (seen.sky + [0.5, -0.25, 2.0]) * UNIT)
    for c in range(3):
        np.testing.assert_array_equal(found.covariance[c], seen.covariance[c] * UNIT[c] ** 2)
    for view, shown, here, other in zip(
        fit.views, found.rendered, seen.observed, seen.unfiltered_views, strict=True
    ):
        wanted = np.asarray(here if other is None else other) * view.covered
        np.testing.assert_array_equal(np.asarray(shown), wanted)
    assert (found.errors, found.status) == ("errors", "converged")
    assert (found.frame, found.sources, found.messages) == ("frame", tuple("abcdef"), ("one",))
    assert found.thetas == ((), (), (), ("r",), (), ("p", "q"))
    assert [len(own) for own in found.structures] == [0, 0, 0, 1, 0, 2]
    learned, own = fit.state.learned, found.structures[5]
    assert found.structures[3] == (None,) and [one.clear for one in own] == [False, True]
    for k, one in enumerate(own):
        np.testing.assert_allclose(one.coefficients[0], learned.structure[k][0], rtol=1e-6)
        assert one.origin == found.components[k].origin
        assert one.strengths.tolist() == learned.strengths[k].tolist()
    fit.state.learned = None  # of another prior
    assert Fit.result(fit, seen).structures == ()
    assert found.losses.tolist() == [3, 2] and found.shifts is fit.shifts
    assert found.observations is fit.blend.observations
    assert found.seconds["fit"] == 2 and 1 < found.seconds["result"] < 2


def test_fits_of_one_signature_are_seen_together(monkeypatch):
    """By the views of each, and as taken where noise was made white; at equal parts of the time."""
    fits, asked, clock = [ended(), ended((None, None))], [], iter([10.0, 13.0, 13.0])
    monkeypatch.setattr(
        room, "render_models", lambda models, **given: asked.append((models, given)) or "seen"
    )
    monkeypatch.setattr(room, "unfiltered_view", lambda home, o, view: (home, o.noise, view))
    monkeypatch.setattr(room, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    assert room.render_fits(fits) == "seen"
    ((models, given),) = asked
    assert given == {"fit_sky": "whether"} and len(models) == 2
    for fit, model in zip(fits, models, strict=True):
        assert model.frame == (24, 32) and model.views is fit.views
        assert model.source is fit.start.source and model.origin is fit.scene.origin
        assert [m.max() for m in model.morphs] == [1, 1, 0]
        assert fit.seconds == {"result": 2.5, "fit": 2.0}
    assert models[0].unfiltered_views == [None, ("home", "correlated", fits[0].views[1])]
    assert models[1].unfiltered_views == [None, None]


def test_fits_start_side_by_side_each_from_its_own_point(monkeypatch):
    clock, asked = iter([10.0, 16.0]), []
    monkeypatch.setattr(
        room,
        "fit_start_profiles",
        lambda patches, fit_sky, tol, second: [p + fit_sky + tol + second for p in patches],
    )
    monkeypatch.setattr(room, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    fits = [
        SimpleNamespace(
            patch=k,
            settings=SimpleNamespace(fit_sky=100, start_tol=1000, adds_components=1e4),
            forget_start=lambda: None,
            begin=lambda *given: asked.append(given),
            blend=SimpleNamespace(structures=(k,) * k),
        )
        for k in range(3)
    ]
    monkeypatch.setattr(room, "carry_structure", asked.append)
    room.start_fits(fits)
    assert asked == [(11100, 2.0), (11101, 2.0), (11102, 2.0), fits[1:]]


def test_memory_of_a_fit_holds_what_its_solver_takes():
    for n_bytes, wanted in ((3000, 3007), (0, 7)):
        settings = SimpleNamespace(solver_bytes=lambda scene, n_bytes=n_bytes: n_bytes)
        fit = SimpleNamespace(settings=settings, scene=SimpleNamespace(n_bytes=7))
        assert room.scene_bytes(fit) == wanted
