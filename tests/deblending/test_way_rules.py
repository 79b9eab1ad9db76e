"""Rules of shifts, of what is seen and of batches, each on few numbers or one small image."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes
from helpers.tuning import tune

from clresample.deblending import batch, iterate as iterate_module
from clresample.deblending.component_images import ComponentImages
from clresample.deblending.linear import renderer as renderer_module
from clresample.deblending.linear.component_batch import StartComponent
from clresample.deblending.linear.linearised_scenes import linearise
from clresample.deblending.linear.render_planner import _WindowRenderer
from clresample.deblending.linear.rendered_models import WHOLE_PX, MorphologyModel, render_models
from clresample.deblending.profiles import StarProfile
from clresample.deblending.shifts import SCATTER_PX, shift_steps
from clresample.deblending.solver.scene import Scene, State
from clresample.deblending.start.profile_start import PRECISION, TOLERANCE, profile_peak
from clresample.deblending.view import SceneGeometry, whitened_view
from clresample.paper import run as paper_run
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

SHIFT = np.array([0.15, -0.1])


class Still:
    """An operator of one channel that shows the model itself."""

    dtype = np.dtype(np.float64)
    shape_in = shape_out = (1, 40, 44)

    def forward(self, image):
        return image


def moved(weight, sky=0.0, mask=False):
    """Two images of a galaxy, the second moved by SHIFT; weight: of that."""
    y, x = np.indices((40, 44))

    def galaxy(dy, dx):
        return np.exp(-0.5 * ((y - 19 - dy) ** 2 + (x - 22 - dx) ** 2) / 9)

    weights = [np.ones((1, 40, 44)), np.full((1, 40, 44), weight)]
    if mask:
        weights[1][:, :20, :24] = 0
    morph = galaxy(0, 0)
    scene = Scene(
        shape=(40, 44),
        unpadded_shape=(40, 44),
        ops=[Still(), Still()],
        data=[morph[None], galaxy(*-SHIFT)[None] + sky],
        weights=weights,
        origin=np.zeros((1, 2), int),
        center=np.array([(19, 22)]),
        profile=[morph],
        fixed=np.zeros(1, bool),
    )
    return scene, State([morph], np.ones((1, 2)), np.array([0.0, sky]))


def test_the_sky_and_masks_move_nothing():
    """Light that the model and the sky explain is subtracted before the slopes are fitted."""
    steps, _ = shift_steps(*moved(1e4, sky=3.0, mask=True))
    assert steps[0].tolist() == [0, 0]
    np.testing.assert_allclose(steps[1], SHIFT, rtol=0.05)


def test_shifts_of_what_holds_little_light_are_smaller():
    """As expected to scatter by 2 px: by half where the data leave as much."""
    assert SCATTER_PX == 2
    power = np.pi / 2 * np.eye(2)  # of the slopes of such a galaxy
    full = shift_steps(*moved(1e9))[0][1]
    for weight in (1 / (4 * np.pi / 2), 0.02):
        wanted = np.linalg.solve(weight * power + np.eye(2) / 4, weight * power @ full)
        np.testing.assert_allclose(shift_steps(*moved(weight))[0][1], wanted, rtol=0.05)


def test_a_sharp_stars_peak_is_of_its_profile_and_not_of_its_slopes():
    home = Frame(Grid.flat((21, 23), 0.1), PSF.gaussian(0.35, n_pixels=15, pixel=False))
    star, place = StarProfile(home, free=True), np.array([10.4, 11.4])
    drawn = star.draw(np.zeros(2), place)
    assert drawn[1:].max() > drawn[0].max()
    found = profile_peak(star, np.zeros(2), place, place, home.shape)
    assert found == pytest.approx(drawn[0].max(), rel=0.01)


def test_morphologies_in_large_frames_are_seen_where_they_are(device):
    """In windows of their boxes, which begin elsewhere along rows and columns; and their spectra
    are found."""
    psf, shape = PSF.gaussian(1.0, n_pixels=19), (170, 180)
    grid = Grid.flat(shape, 0.1)
    home = Frame(grid, scenes.MODEL_PSF)
    y, x = np.indices((15, 13))
    morph = np.exp(-0.5 * ((y - 7) ** 2 + (x - 6) ** 2) / 4)
    origin = np.array([[20, 120], [130, 40]])
    assert np.prod(shape) > WHOLE_PX
    data = np.zeros((1, *shape))
    blank = Observation(data, psf, grid, weights=4.0, channels=("g",))
    place = SceneGeometry(home, home, origin + [7, 6.0], 0.0)
    view = whitened_view(place, blank, 1, device, np.float32, private=False)
    whole = np.zeros((2, *shape), np.float32)
    for image, (a, b) in zip(whole, origin, strict=True):
        image[a : a + 15, b : b + 13] = morph
    shown = view.op.render(whole)
    light = 3 * shown[0] + 5 * shown[1] + 0.5
    names = "op", "sqrt_weights", "coefficients", "ties", "error_scale", "sky_precision"
    filled = SimpleNamespace(**{name: getattr(view, name) for name in names})
    filled.mapping, filled.data, filled.covered = view.mapping, 2 * light, view.covered
    for fit_sky in (True, False):
        filled.data = 2 * (light - 0.5 * (not fit_sky))
        model = MorphologyModel(shape, [filled], [None], np.zeros(2, int), origin, [morph, morph])
        (seen,) = render_models([model], fit_sky=fit_sky)
        (rendered,) = seen.observed
        assert isinstance(rendered, ComponentImages) and rendered.images[0].size < 0.2 * data.size
        np.testing.assert_allclose(np.asarray(rendered), shown, atol=1e-4 * shown.max())
        np.testing.assert_allclose(seen.spectra[:, 0], [6, 10], rtol=1e-3)
        np.testing.assert_allclose(seen.sky, [1.0 * fit_sky], atol=1e-3)
        assert seen.unfiltered_views == (None,)


def test_slots_are_rendered_in_groups_of_what_the_memory_takes(device, monkeypatch):
    """One at a time or all at once: the same is seen. No more than a launch has groups for."""
    home, position = scenes.frame(), np.array([14.0, 17.0])
    star = StarProfile(home, free=True)
    places = [position + (k - 2) for k in range(5)]
    chosen = [StartComponent(0, k, k, star, place, home.shape) for k, place in enumerate(places)]
    found = []
    for n_bytes, most in ((1, 65535), (1 << 30, 65535), (1 << 30, 2 * 3 * 2)):
        tune(monkeypatch, group_bytes=n_bytes)
        monkeypatch.setattr(renderer_module, "MAX_GROUPS", most)
        views = [
            whitened_view(
                SceneGeometry(home, home, np.array(places), 0.0),
                o,
                1,
                device,
                np.float32,
                private=True,
            )
            for o in scenes.observe()
        ]
        looking = linearise([views], chosen, PRECISION, TOLERANCE, fit_sky=False)
        looking.render([0], [np.zeros(2)] * 5, np.ones(5), slopes=True)
        found.append([device.get(sight.seen) for sight in looking.sights])
        for sight, n_bands in zip(looking.sights, (1, 2), strict=True):
            (windows,) = sight.aim._renderers.values()
            slots = 1 if n_bytes == 1 else min(5, most // (3 * n_bands))
            assert windows.renderer._capacity == 3 * slots
    for one, *others in zip(*found, strict=True):
        for other in others:
            np.testing.assert_allclose(one, other, atol=1e-6 * np.abs(one).max())


def a_star(device, shape):
    """One in the middle of a small frame, where it is, and two views of it."""
    home, place = scenes.frame(shape), np.array([9.0, 11.0])
    at_home = SceneGeometry(home, home, place[None], 0.0)
    views = [
        whitened_view(at_home, o, 1, device, np.float32, private=True)
        for o in scenes.observe(shape=shape)
    ]
    return StartComponent(0, 0, 0, StarProfile(home, free=True), place, shape), place, views


def test_signal_to_noise_is_zero_where_nothing_was_seen(device):
    """<u, d> / |u| of what was, both in units of the noise."""
    star, place, views = a_star(device, (20, 23))
    views[1] = replace(views[1], sqrt_weights=0 * views[1].sqrt_weights)
    looking = linearise([views], [star], PRECISION, 0.0, fit_sky=False)
    looking.render([0], [np.zeros(2)], np.ones(1), slopes=False)
    found = looking.signal_to_noise(np.zeros((1, 3)))
    u = views[0].sqrt_weights * views[0].op.render(star.shape.draw(np.zeros(2), place)[:1])[0]
    wanted = (u * views[0].sqrt_weights * views[0].data).sum() / np.linalg.norm(u)
    np.testing.assert_allclose(found, [[wanted, 0, 0]], rtol=1e-3)


def test_boxes_of_a_whole_frame_are_seen_through_the_observations_own_operator(device):
    """That operator exists already, whatever the frame's sides are."""
    star, _, views = a_star(device, (20, 23))
    looking = linearise([views], [star], PRECISION, 0.0, fit_sky=False)
    looking.render([0], [np.zeros(2)], np.ones(1), slopes=True)
    assert looking.slots.size.tolist() == [[20, 23]]
    for sight, view in zip(looking.sights, views, strict=True):
        (renderer,) = sight.aim._renderers.values()
        assert renderer.plans == [view.op.plans[0]]


def running(live, n_steps=5, resize=False):
    """A batch of fits on their way, as `repacked` and `run` see it."""
    one = object.__new__(paper_run.AmsgradRun)
    one.live = np.array(live)
    one.tracks = [SimpleNamespace(fit=name) for name in "abcdefgh"[: len(live)]]
    one.engine = SimpleNamespace(n_steps=n_steps)
    return one


def test_a_batch_is_made_anew_when_a_quarter_has_stopped():
    assert (iterate_module.REPACK_FRACTION, paper_run.RESIZE_ITERATIONS) == (0.25, 40)
    going = running([True] * 7 + [False])
    assert going.repacked() is going and going.going() == list("abcdefg")
    with pytest.raises(AttributeError):  # asks its engine for states
        running([True, True, True, False]).repacked()
    with pytest.raises(AttributeError):
        running([True] * 8, n_steps=40).repacked()
    one = object.__new__(iterate_module.LbfgsRun)
    one.engine = SimpleNamespace(progress=SimpleNamespace(live=np.array([True] * 7 + [False])))
    assert one.repacked() is one


def test_learning_runs_five_rounds_at_a_time_and_no_more_than_it_may():
    """The start is none of them."""
    assert iterate_module.CHECK_ITERATIONS == 5
    for max_iter, wanted in ((100, [6, 5, 5]), (7, [6, 2, 0])):
        one, rounds = object.__new__(iterate_module.LbfgsRun), []
        n = np.zeros(2, int)
        progress = SimpleNamespace(
            live=np.array([True, False]),
            converged=np.zeros(2, bool),
            tested=np.zeros(2, bool),
            n_rounds=n,
            loss=np.array([3.0, 4.0]),
        )

        def go(n=n, rounds=rounds):
            n[0] += 1
            rounds.append(1)
            return np.array([True, False])

        one.engine = SimpleNamespace(progress=progress, round=go)
        one.fits = [SimpleNamespace(losses=[]), SimpleNamespace(losses=[])]
        one.settings = SimpleNamespace(max_iter=max_iter, fit_shifts=False)
        settled = []
        one.settle = lambda stop, settled=settled: settled.append(stop.tolist())
        one._take_joint_steps = lambda which: None
        for k in wanted:
            rounds.clear()
            np.testing.assert_array_equal(one.run(), [[3, 4]])
            assert len(rounds) == k
        assert len(one.fits[0].losses) == sum(wanted) and one.fits[1].losses == []
        assert settled == ([] if max_iter == 100 else [[True, False]])


def test_light_lies_in_the_middle_of_its_window():
    """If that is larger than one scene's light needs; mappings begin at the first light."""
    rng = np.random.default_rng(0)
    maps = [
        SimpleNamespace(offset=rng.normal(size=2), matrix=rng.normal(size=(2, 2))) for _ in "ab"
    ]
    renderer = SimpleNamespace(size=(24, 31), plans=[SimpleNamespace(mapping=m) for m in maps])
    found = _WindowRenderer(np.arange(2), renderer, np.array([(20, 20), (24, 30)]))
    assert found.before.tolist() == [[2, 5], [0, 0]]
    for m, before, offset in zip(maps, found.before, found.offset, strict=True):
        np.testing.assert_allclose(offset, m.matrix @ before + m.offset)


@pytest.mark.parametrize("group", ["b", "ab", "ba", "abc", "bb", "ac"])
def test_a_fit_that_cannot_start_leaves_the_others(monkeypatch, group):
    """b fails, whoever starts beside it; a group that starts is started once, others by halves."""
    begun = []

    def begin(fits):
        begun.append(len(fits))
        if any(fit.blend == "b" for fit in fits):
            raise ValueError("no")

    monkeypatch.setattr(batch, "start_fits", begin)
    many = object.__new__(batch._BatchRunner)
    many.done, many.warned = {}, {}
    fits = [
        (10 + i, SimpleNamespace(blend=name, undetected=[7], problems=[]))
        for i, name in enumerate(group)
    ]
    good = [one for one in fits if one[1].blend != "b"]
    assert many._begin(fits) == good
    assert {i: (done.status, done.reason) for i, done in many.done.items()} == {
        i: ("failed", "no") for i, fit in fits if fit.blend == "b"
    }
    assert many.warned == {i: ([7], []) for i, _ in good}

    def starts(part):
        if "b" not in part or len(part) == 1:
            return [len(part)]
        middle = len(part) // 2
        return [len(part), *starts(part[:middle]), *starts(part[middle:])]

    assert begun == starts(group)
