"""Rules of shifts, of rendering and of batches, each on few numbers or one small image."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes
from helpers.tuning import tune

from clresample.deblending import iterate as iterate_module
from clresample.deblending.profiles import Star
from clresample.deblending.rendered import Rendered
from clresample.deblending.shifts import SCATTER_PX, shift_steps
from clresample.deblending.solver.boxes import Boxes
from clresample.deblending.solver.rendering import choice
from clresample.deblending.solver.rendering.windows import ROUND_PX, Groups
from clresample.deblending.solver.scene import Scene, State
from clresample.deblending.start import renderer as renderer_module
from clresample.deblending.start.looking import looking_at
from clresample.deblending.start.seen import WHOLE_PX, Model, see
from clresample.deblending.start.slots import Component
from clresample.deblending.start.start import PRECISION, TOLERANCE, _peak
from clresample.deblending.view import Home, whitened_view
from clresample.device.contraction import COLUMN_PAD
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
        extent=(40, 44),
        ops=[Still(), Still()],
        data=[morph[None], galaxy(*-SHIFT)[None] + sky],
        weights=weights,
        origin=np.zeros((1, 2), int),
        center=np.array([(19, 22)]),
        profile=[morph],
        fixed=np.zeros(1, bool),
        scale=np.ones((1, 2)),
    )
    return scene, State([0 * morph], [morph], np.ones((1, 2)), np.array([0.0, sky]))


def test_the_sky_and_masks_move_nothing():
    """What the model and the sky explain is taken off before the slopes are asked."""
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
    star, place = Star(home, free=True), np.array([10.4, 11.4])
    drawn = star.draw(np.zeros(2), place)
    assert drawn[1:].max() > drawn[0].max()
    found = _peak(Component(0, 0, 0, star, place, home.shape), np.zeros(2), place)
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
    place = Home(home, home, origin + [7, 6.0], 0.0)
    view = whitened_view(place, blank, 1, device, np.float32, private=False)
    whole = np.zeros((2, *shape), np.float32)
    for image, (a, b) in zip(whole, origin, strict=True):
        image[a : a + 15, b : b + 13] = morph
    shown = view.op.render(whole)
    light = 3 * shown[0] + 5 * shown[1] + 0.5
    filled = SimpleNamespace(**{name: getattr(view, name) for name in ("op", "root", "shares")})
    filled.mapping, filled.data, filled.covered = view.mapping, 2 * light, view.covered
    for fit_sky in (True, False):
        filled.data = 2 * (light - 0.5 * (not fit_sky))
        model = Model(shape, [filled], [None], np.zeros(2, int), origin, [morph, morph])
        (seen,) = see([model], fit_sky=fit_sky)
        (rendered,) = seen.observed
        assert isinstance(rendered, Rendered) and rendered.images[0].size < 0.2 * data.size
        np.testing.assert_allclose(np.asarray(rendered), shown, atol=1e-4 * shown.max())
        np.testing.assert_allclose(seen.spectra[:, 0], [6, 10], rtol=1e-3)
        np.testing.assert_allclose(seen.sky, [1.0 * fit_sky], atol=1e-3)
        assert seen.bare == (None,)


def test_slots_are_rendered_in_groups_of_what_the_memory_takes(device, monkeypatch):
    """One at a time or all at once: the same is seen. No more than a launch has groups for."""
    home, position = scenes.frame(), np.array([14.0, 17.0])
    star = Star(home, free=True)
    places = [position + (k - 2) for k in range(5)]
    chosen = [Component(0, k, k, star, place, home.shape) for k, place in enumerate(places)]
    found = []
    for n_bytes, most in ((1, 65535), (1 << 30, 65535), (1 << 30, 2 * 3 * 2)):
        tune(monkeypatch, group_bytes=n_bytes)
        monkeypatch.setattr(renderer_module, "MOST_GROUPS", most)
        views = [
            whitened_view(
                Home(home, home, np.array(places), 0.0), o, 1, device, np.float32, private=True
            )
            for o in scenes.observe()
        ]
        looking = looking_at([views], chosen, PRECISION, TOLERANCE, fit_sky=False)
        looking.look([0], [np.zeros(2)] * 5, np.ones(5), slopes=True)
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
    at_home = Home(home, home, place[None], 0.0)
    views = [
        whitened_view(at_home, o, 1, device, np.float32, private=True)
        for o in scenes.observe(shape=shape)
    ]
    return Component(0, 0, 0, Star(home, free=True), place, shape), place, views


def test_signal_to_noise_is_zero_where_nothing_was_seen(device):
    """<u, d> / |u| of what was, both in units of the noise."""
    star, place, views = a_star(device, (20, 23))
    views[1] = replace(views[1], root=0 * views[1].root)
    looking = looking_at([views], [star], PRECISION, 0.0, fit_sky=False)
    looking.look([0], [np.zeros(2)], np.ones(1), slopes=False)
    found = looking.signal_to_noise(np.zeros((1, 3)))
    u = views[0].root * views[0].see(star.shape.draw(np.zeros(2), place)[:1], 0)[0]
    wanted = (u * views[0].root * views[0].data).sum() / np.linalg.norm(u)
    np.testing.assert_allclose(found, [[wanted, 0, 0]], rtol=1e-3)


def test_boxes_of_a_whole_frame_are_seen_through_the_observations_own_operator(device):
    """Which is made already, whatever the frame's sides are."""
    star, _, views = a_star(device, (20, 23))
    looking = looking_at([views], [star], PRECISION, 0.0, fit_sky=False)
    looking.look([0], [np.zeros(2)], np.ones(1), slopes=True)
    assert looking.slots.size.tolist() == [[20, 23]]
    for sight, view in zip(looking.sights, views, strict=True):
        (renderer,) = sight.aim._renderers.values()
        assert renderer.plans == [view.op.plans[0]]


def boxes_at(*places, scene=None, n=8):
    count = len(places)
    return Boxes(
        np.zeros(count, int) if scene is None else np.array(scene),
        np.array(places),
        np.full((count, 2), n),
    )


def test_groups_are_of_the_cells_that_hold_the_middles_of_boxes():
    """Of those that are meant, by scene; frames of one size, multiples of 16, about all of each."""
    boxes = boxes_at((0, 0), (5, 9), (7, 12), (40, 3), (0, 0), (3, 3), scene=[0, 0, 0, 0, 1, 1])
    groups = Groups(boxes, np.array([0, 1, 2, 3, 4]), np.array([10, 16]))
    assert ROUND_PX == 16 and len(groups) == 4
    assert groups.group.tolist() == [0, 0, 1, 2, 3, 0] and groups.scene.tolist() == [0, 0, 0, 1]
    assert groups.low.tolist() == [[0, 0], [7, 12], [40, 3], [0, 0]]
    assert groups.shape.tolist() == [16, 32]  # 13 x 17 pixels of the first
    exact = Groups(boxes_at((0, 0), (8, 8)), np.arange(2), np.array([50, 50]))
    assert exact.shape.tolist() == [16, 16] and exact.low.tolist() == [[0, 0]]


def test_operations_are_counted_from_sizes():
    """Products of matrices, four operations a term and pair; weighed sums at points beside them."""
    shape, (n_y, n_x, k_y, k_x) = np.array([[3, 5], [4, 2]]), (20, 30, 16, 48)
    of_frame, of_box = np.tile([k_y, k_x], (2, 1)), np.tile([k_y, k_x], (2, 1))
    found = choice._counts(shape, 3, n_y, n_x, of_frame, of_box)
    rows, pixels, n_images = 7, 23, 6
    second = n_images * k_y * n_y * k_x
    wanted = [
        n_images * n_y * n_x * k_x + second + choice.POINT * 1.5 * 3 * pixels,
        choice.BOXED * pixels * k_x + second + choice.POINT * 1.5 * 3 * rows * k_x,
        choice.BOXED * (pixels * k_x + rows * k_y * k_x) + choice.POINT * 1.5 * 3 * 2 * k_y * k_x,
    ]
    np.testing.assert_allclose(found, 4 * np.array(wanted))
    # each frame, and each box in it, has waves of its own
    of_frame, of_box = np.array([[4, 32], [6, 16]]), np.array([[6, 16], [4, 32]])
    first, second = 3 * 20 * 30 * (32 + 16), 3 * 20 * (4 * 32 + 6 * 16)
    to_lines, to_planes = 15 * 16 + 8 * 32, 3 * 6 * 16 + 4 * 4 * 32
    by_pixel, by_line, by_wave = 23, 3 * 16 + 4 * 32, 6 * 16 + 4 * 32
    wanted = [
        first + second + choice.POINT * 4.5 * by_pixel,
        choice.BOXED * to_lines + second + choice.POINT * 4.5 * by_line,
        choice.BOXED * (to_lines + to_planes) + choice.POINT * 4.5 * by_wave,
    ]
    found = choice._counts(shape, 3, 20, 30, of_frame, of_box)
    np.testing.assert_allclose(found, 4 * np.array(wanted))
    plain, lines = SimpleNamespace(lines=None), SimpleNamespace(lines=1)
    assert choice._observed(plain, 5, 7, 11, 13) == 5 * 11 * 13 + 5 * 13 * 7
    assert choice._observed(lines, 5, 7, 11, 13) == 11 * 13 * 7 + 11 * 7 * 5


@pytest.mark.parametrize("axes", [[0, 1], [1, 0]])
def test_operations_are_those_of_an_executors_plans(axes, monkeypatch):
    """One for all scenes, or one each; their waves along x are padded to whole vectors."""
    monkeypatch.setattr(choice, "_counts", lambda *given: given)
    boxes = SimpleNamespace(shape=np.array([[3, 5], [4, 2], [6, 7]]), scene=np.array([0, 0, 1]))
    buffers = SimpleNamespace(host_boxes=boxes, scenes=[0, 1])
    op = SimpleNamespace(shape_in=(3, 40, 50))
    for k_ys, k_xs in (([11], [17]), ([11, 9], [17, 33])):
        executor = SimpleNamespace(
            axes=axes, n_y=40, n_x=50, k_ys=np.array(k_ys), k_xs=np.array(k_xs)
        )
        shape, *sizes, of_frame, of_box = choice.flops(buffers, op, executor)
        np.testing.assert_array_equal(shape, boxes.shape[:, axes])
        assert sizes == [3, 40, 50]
        waves = np.stack([np.array(k_ys), -(-np.array(k_xs) // COLUMN_PAD) * COLUMN_PAD], axis=1)
        np.testing.assert_array_equal(of_frame, waves[[0, -1]])
        np.testing.assert_array_equal(of_box, waves[[0, 0, -1]])


@pytest.mark.parametrize("axes", [(0, 1), (1, 0)])
@pytest.mark.parametrize("lines", [None, True, False])
def test_operations_in_windows_are_those_of_smaller_frames(axes, lines, monkeypatch):
    """Frequencies and columns shrink with the frame and its reach; what is observed is what a
    window shows, of pixels half as large along y and of a third along x."""
    executor = SimpleNamespace(axes=axes, n_y=100, n_x=80, k_y=60, k_x=50, n_columns=70)
    plan = SimpleNamespace(
        lines=None if lines is None else SimpleNamespace(by_row=lines),
        mapping=SimpleNamespace(matrix=np.diag([1 / 2, 1 / 3])),
    )
    reach = 5
    monkeypatch.setattr(choice, "reach_of", lambda _: reach)
    op = SimpleNamespace(executor=lambda: executor, plans=[plan], shape_out=(3, 9, 9))
    boxes = boxes_at((9, 9), (0, 0), (3, 10), (40, 3), n=8)
    groups = Groups(boxes, np.array([1, 2, 3]), np.array([10, 20]))
    n_y, n_x = groups.shape[list(axes)]
    assert len(groups) == 2 and groups.shape.tolist() == [16, 32]
    k_y, k_x = 60 * (n_y + 2 * reach) / (100 + reach), 50 * (n_x + 2 * reach) / (80 + reach)
    along_y, along_x = 2 * (16 + 2 * reach), 3 * (32 + 2 * reach)
    if lines is None:
        observed = along_y * k_x * (k_y + along_x)
    else:
        n_columns = 70 * (n_x + 2 * reach) / 80
        observed = k_y * n_columns * (k_x + (along_y if lines else along_x))
    waves = np.tile([k_y, k_x], (3, 1))
    counts = choice._counts(np.full((3, 2), 8), 3, n_y, n_x, waves[:2], waves)
    found = choice._window_flops(boxes, op, groups)
    assert found == pytest.approx(min(counts) + 4 * 2 * 3 * observed)


def parts_of(monkeypatch, sides, cost, *, count=1000.0, n_plans=1, n_terms=1, geometry="affine"):
    """The sources of each part that is rendered in windows, which cost as much as `cost` of their
    indices says; None without windows. Frames of 200 pixels, 3 images of 25 operations more."""
    executor = SimpleNamespace(n_rows=1, n_columns=2, k_y=3, k_x=4)
    op = SimpleNamespace(
        plans=[None] * n_plans,
        n_terms=n_terms,
        geometry=geometry,
        shape_in=(3, 200, 200),
        shape_out=(3, 9, 9),
        executor=lambda: executor,
    )
    boxes = SimpleNamespace(shape=np.array([(n, n) for n in sides]))
    monkeypatch.setattr(choice, "reach_of", lambda _: 30)
    monkeypatch.setattr(
        choice, "_observed", lambda *given: 25.0 if given[1:] == (1, 2, 3, 4) else 0
    )
    monkeypatch.setattr(
        choice, "_best_groups", lambda b, o, which: (cost(which.tolist()), which.tolist())
    )
    buffers = SimpleNamespace(host_boxes=boxes, scenes=[0])
    return choice._parts(buffers, op, count)


def test_windows_are_taken_where_they_save_most(monkeypatch):
    """For 0.4 of all operations at most; boxes far larger than the median's may have their own."""
    assert choice.GAIN == 0.4 and choice.LARGE.tolist() == [1.3, 1.6, 2.0]
    few, limit = [20] * 4, 0.4 * (1000 + 4 * 3 * 25)
    everyone = [[0, 1, 2, 3]]
    assert parts_of(monkeypatch, few, lambda _: limit - 1) == everyone
    assert parts_of(monkeypatch, few, lambda _: limit + 1) is None
    for given in ({"n_plans": 2}, {"n_terms": 2}, {"geometry": "distorted"}):
        assert parts_of(monkeypatch, few, lambda _: 1.0, **given) is None
    assert parts_of(monkeypatch, [40] * 3, lambda _: 1.0) == [[0, 1, 2]]  # 40 + 2 x 30 = 200 / 2
    assert parts_of(monkeypatch, [41] * 3, lambda _: 1.0) is None
    sides = [20] * 5 + [25, 31, 39, 41]
    for n in (6, 7, 8):
        costs = {n: 10.0, 9 - n: 20.0}
        found = parts_of(monkeypatch, sides, lambda which, c=costs: c.get(len(which), 300.0))
        assert found == [list(range(n)), list(range(n, 9))]
    costs = {9: 100.0}
    found = parts_of(monkeypatch, sides, lambda which: costs.get(len(which), 51.0))
    assert found == [list(range(9))]


def running(live, n_steps=5, resize=False):
    """A batch of fits on their way, as `repacked` and `run` see it."""
    one = object.__new__(iterate_module._Running)
    one.live, one.fits = np.array(live), list("abcdefgh"[: len(live)])
    one.engine = SimpleNamespace(n_steps=n_steps)
    return one


def test_a_batch_is_made_anew_when_a_quarter_has_stopped():
    assert (iterate_module.REPACK, iterate_module.RESIZE) == (0.25, 40)
    going = running([True] * 7 + [False])
    assert going.repacked() is going and going.going() == list("abcdefg")
    with pytest.raises(AttributeError):  # asks its engine for states
        running([True, True, True, False]).repacked()
    with pytest.raises(AttributeError):
        running([True] * 8, n_steps=40).repacked()
    one = object.__new__(iterate_module._Learning)
    one.engine = SimpleNamespace(progress=SimpleNamespace(live=np.array([True] * 7 + [False])))
    assert one.repacked() is one


def test_learning_runs_five_rounds_at_a_time_and_no_more_than_it_may():
    """The start is none of them."""
    assert iterate_module.CHECK == 5
    for max_iter, wanted in ((100, [6, 5, 5]), (7, [6, 2, 0])):
        one, rounds = object.__new__(iterate_module._Learning), []
        n = np.zeros(2, int)
        progress = SimpleNamespace(
            live=np.array([True, False]),
            converged=np.zeros(2, bool),
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
        for k in wanted:
            rounds.clear()
            np.testing.assert_array_equal(one.run(), [[3, 4]])
            assert len(rounds) == k
        assert len(one.fits[0].losses) == sum(wanted) and one.fits[1].losses == []
        assert settled == ([] if max_iter == 100 else [[True, False]])
