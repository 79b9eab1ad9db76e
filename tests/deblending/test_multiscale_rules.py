"""Decisions of the solver that learns, each alone: accepted, shortened, given up, converged."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.progress import falls

from clresample.deblending.solver.multiscale import lbfgs_control as progress_module
from clresample.deblending.solver.multiscale.engine import (
    MultiscaleEngine,
    _inverse_curvature,
    _n_pixels,
    vector_bytes,
)
from clresample.deblending.solver.multiscale.lbfgs_control import (
    COMMON_ROUNDS,
    CONVERGENCE_WINDOW,
    FIRST_STRENGTH_ROUND,
    MAX_TRIALS,
    STRENGTH_ROUNDS,
    LbfgsControl,
)
from clresample.deblending.solver.multiscale.lbfgs_steps import AGAIN, NEXT, REST, STAY, TRY
from clresample.deblending.solver.multiscale.prior import MultiscalePrior, gaussian


def begun(*losses, loss_tol=0.5, n_pixels=1000):
    """Scenes whose starts have these losses."""
    progress = LbfgsControl(len(losses), loss_tol, [n_pixels] * len(losses))
    accepted, stepped = progress.accept_trials(np.array(losses, float), np.zeros(len(losses)))
    assert accepted.all() and not stepped.any()
    mode, length, bare = progress.next_actions(accepted)
    assert (mode == NEXT).all() and (length == 1).all() and not bare.any()
    assert progress.n_iterations.tolist() == [0] * len(losses)
    return progress


def judged(progress, loss, slope):
    """One round: accepted, stepped, mode, length, bare."""
    found = progress.accept_trials(np.array(loss, float), np.array(slope, float))
    return *found, *progress.next_actions(found[0])


def test_a_start_without_a_loss_has_failed():
    progress = LbfgsControl(3, 0.5, [10, 10, 10])
    accepted, _ = progress.accept_trials(np.array([5.0, np.nan, np.inf]), np.zeros(3))
    assert accepted.tolist() == [True, False, False]
    assert progress.failed.tolist() == [False, True, True]
    assert progress.live.tolist() == [True, False, False]
    assert progress.n_rounds.tolist() == [1, 1, 1]
    assert progress.next_actions(accepted)[0].tolist() == [NEXT, REST, REST]
    progress.accept_trials(np.array([4.0, 5.0, 5.0]), np.array([-1.0, 0.0, 0.0]))
    assert progress.n_rounds.tolist() == [2, 1, 1]  # of those that go on


def test_a_trial_must_gain_a_part_of_what_its_slope_promises():
    """1e-4 of a slope of -100 from a loss of 10: 9.99, and no step is taken uphill."""
    progress = begun(10, 10, 10, 10)
    accepted, stepped, mode, length, bare = judged(
        progress, [9.989, 9.991, 9.0, np.nan], [-100, -100, 1, -100]
    )
    assert accepted.tolist() == stepped.tolist() == [True, False, False, False]
    assert progress.loss.tolist() == [9.989, 10, 10, 10]
    assert progress.n_iterations.tolist() == [1, 0, 0, 0]
    # the minimum of the parabola through the trial lies half-way; NaN asks for the shortest step
    assert mode.tolist() == [NEXT, TRY, AGAIN, TRY] and bare.tolist() == [False, False, True, False]
    np.testing.assert_allclose(length, [1, 0.5, 1, 0.1], rtol=1e-3)
    assert not progress.failed.any()


def test_steps_shrink_to_the_minimum_of_a_parabola_within_limits():
    """Loss 10 with slope -4 and the trial's losses: 4 / (2 (loss - 10 + 4)) of the length."""
    progress = begun(*[10] * 4)
    *_, length, _ = judged(progress, [11, 16, 100, 10.01], [-4] * 4)
    np.testing.assert_allclose(length, [4 / 10, 4 / 20, 0.1, 4 / 8.02], rtol=1e-6)
    *_, length, _ = judged(progress, [11, 16, 100, 10.01], [-4] * 4)
    np.testing.assert_allclose(length, np.array([4 / 10, 4 / 20, 0.1, 4 / 8.02]) ** 2, rtol=1e-6)
    *_, length, _ = judged(progress, [5] * 4, [-4] * 4)
    assert (length == 1).all()
    *_, length, _ = judged(progress, [5.0001] * 4, [-0.0004] * 4)  # whatever the unit
    np.testing.assert_allclose(length, 0.4, rtol=1e-6)


def test_a_direction_is_given_up_after_eight_trials_and_the_scene_after_eight_more():
    """The memory is dropped first; then strengths are learned from here, or it has converged."""
    progress = begun(10, 10)
    progress.settled[:] = [False, True]
    assert MAX_TRIALS == 8
    for i in range(1, 17):
        *_, mode, length, bare = judged(progress, [11, 11], [-1, -1])
        if i == 8:
            assert mode.tolist() == [AGAIN, AGAIN] and bare.all() and (length == 1).all()
        elif i < 16:
            assert mode.tolist() == [TRY, TRY] and not bare.any()
            assert progress._trials.tolist() == [i % 8] * 2
    assert mode.tolist() == [STAY, REST] and progress.converged.tolist() == [False, True]
    assert progress.live.tolist() == [True, False]
    accepted, stepped = progress.accept_trials(np.array([12.0, 9.0]), np.array([0.0, -1.0]))
    assert accepted.tolist() == [True, False] and not stepped.any()  # where it is already
    assert progress.loss.tolist() == [12, 10]
    assert progress.strengths_due(accepted).tolist() == [True, False]


def test_a_step_uphill_drops_the_memory_at_once():
    progress = begun(10)
    *_, mode, length, bare = judged(progress, [11], [0.0])
    assert mode[0] == AGAIN and bare[0] and length[0] == 1
    *_, mode, length, bare = judged(progress, [9], [-1])
    assert mode[0] == NEXT and not bare[0]
    *_, mode, length, bare = judged(progress, [9.5], [1])  # again after a step that gained
    assert mode[0] == AGAIN and bare[0]
    *_, mode, length, bare = judged(progress, [9.5], [1])
    assert mode[0] == STAY and not bare[0] and progress.live[0]


@pytest.mark.parametrize("total, ends", [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("chi2", [0.5, 3.0])
def test_a_fit_has_converged_when_ten_iterations_gain_too_little(total, ends, chi2):
    """`loss_tol`, times chi2 per pixel where that is above 1; once strengths have settled."""
    loss = 0.5 * chi2 * 1000
    start = loss + 10
    progress = begun(start, start, loss_tol=0.5)
    progress.settled[0] = True
    losses = np.linspace(start, loss, 2).tolist()
    fall = total * max(chi2, 1) / CONVERGENCE_WINDOW
    now = losses[1]
    judged(progress, [now, now], [-1e-9] * 2)
    for i in range(CONVERGENCE_WINDOW):
        now -= fall
        *_, mode, _, _ = judged(progress, [now, now], [-1e-9] * 2)
        assert progress.live.all() or (i == CONVERGENCE_WINDOW - 1 and ends)
    assert progress.converged.tolist() == [ends, False]
    assert mode.tolist() == [NEXT, NEXT]  # a trial that was accepted is kept


def test_strengths_are_learned_after_sixteen_rounds_and_then_every_eighth():
    assert (FIRST_STRENGTH_ROUND, STRENGTH_ROUNDS, progress_module.MAX_LOG_STRENGTH_CHANGE) == (
        16,
        8,
        0.1,
    )
    progress, due = LbfgsControl(1, 0.5, [10_000]), []
    for i in range(1, 41):
        accepted, _ = progress.accept_trials(np.array([1000.0 - 5 * i]), np.array([-1e-6]))
        if progress.strengths_due(accepted)[0]:
            due.append(i)
            moved = 0.11 if i < 30 else 0.09
            progress.record_strengths(np.array([True]), np.array([moved]), np.array([0.25]))
            assert progress.settled[0] == (moved < 0.1)
            assert np.isinf(progress._losses[0, 1:]).all()
        progress.next_actions(accepted)
    assert due == [16, 24, 32]


def test_strengths_are_learned_at_once_where_little_is_left_to_gain():
    """Where three iterations have gained less than 5, in rounds that are multiples of four; and
    not again before three more."""
    progress, due, loss = LbfgsControl(1, 0.5, [100]), [], 50.0
    for i, drop in enumerate([9, 9, 9, 3, 1, 0.5, 0.1, 0.1, 9, 0.1, 0.1, 0.1, 0.1], 1):
        loss -= drop
        accepted, _ = progress.accept_trials(np.array([loss]), np.array([-1e-6]))
        if progress.strengths_due(accepted)[0]:
            due.append(i)
            progress.record_strengths(np.array([True]), np.array([0.2]), np.zeros(1))
        progress.next_actions(accepted)
    assert due == [8, 12]


def test_a_scene_that_is_stuck_learns_in_any_round():
    progress = begun(10.0)
    progress._due[0] = 0
    assert progress.n_rounds[0] % COMMON_ROUNDS and progress.strengths_due(np.array([True]))[0]


@pytest.mark.parametrize("due", [(True, False), (False, True), (True, True), (False, False)])
def test_a_scene_learns_when_it_is_due_though_others_are_not(due):
    one, learned, sums = object.__new__(MultiscaleEngine), [], np.zeros((2, 3, 4))
    one.progress = SimpleNamespace(
        accept_trials=lambda *_: (np.ones(2, bool), np.zeros(2, bool)),
        strengths_due=lambda _: np.array(due),
        significance_due=lambda _: np.zeros(2, bool),
        next_actions=lambda _: (None, None, None),
        n_rounds=np.zeros(2, int),
    )
    one.strengths = SimpleNamespace(take_blocks=lambda _: None)
    one.pairs = SimpleNamespace(
        take=lambda *_: None, forget=lambda _: None, coefficients=lambda *_: (None, None, None)
    )
    one.steps = SimpleNamespace(follow=lambda *_: None, advance=lambda *_: None)
    one._evaluate = lambda: (sums, None, None)
    one._learn = lambda which: learned.append(tuple(which.tolist())) or sums
    one.round()
    assert learned == ([due] if any(due) else [])


def test_another_loss_is_looked_at_where_the_scene_is():
    """Of scenes that have moved; converged ones go on."""
    progress = begun(10, 10, 10)
    progress.settled[:] = True
    falls(progress, 0, 0, 0)
    progress.next_actions(np.array([True, True, False]))
    assert progress.converged.tolist() == [True, True, False]
    progress.refresh_loss(np.array([True, False, True]))
    assert progress.live.tolist() == [True, False, True]
    assert progress.converged.tolist() == [False, True, False]
    assert np.isinf(progress._losses[[0, 2], 1:]).all() and (progress._losses[1] == 10).all()
    accepted, stepped = progress.accept_trials(np.array([20.0, 20.0, 20.0]), np.zeros(3))
    assert accepted.tolist() == [True, False, True] and not stepped.any()


@pytest.mark.parametrize(
    "before, now, ends",
    [(0.2, 0.05, True), (0.051, 0.05, False), (0.0011, 0.001, True), (5.0, 0.11, False)],
)
def test_a_fit_goes_on_while_a_series_of_its_falls_promises_more(before, now, ends):
    """Falls in each of ten iterations, loss_tol 0.5: 5 now, 25 now^2 / (5 before - 5 now) later;
    none below a fiftieth of loss_tol counts."""
    progress = begun(10)
    progress.settled[:] = True
    progress._losses[0, ::-1] = 10 + np.cumsum([0, *[-before] * 5, *[-now] * 5])
    progress.next_actions(np.array([True]))
    assert progress.converged.tolist() == [ends]


def test_a_resumed_scene_converges_again_unless_the_step_gains():
    """0.1 and 1 in one step, of which 0.5 are loss_tol; falls before were far larger, then none."""
    progress = begun(10, 10)
    progress.settled[:], progress.converged[:], progress.live[:] = True, True, False
    progress._losses[:] = np.where(np.arange(progress._losses.shape[1]) > 5, 100, 10)
    progress.resume(np.ones(2, bool))
    assert progress.live.all() and not progress.converged.any()
    judged(progress, [9.9, 9.0], [-1, -1])
    assert progress.converged.tolist() == [True, False]


def test_some_scenes_go_on_alone():
    progress = begun(10, 20, 30)
    progress.n_rounds[:] = [1, 2, 3]
    part = progress.take(np.array([2, 0]))
    assert part.loss.tolist() == [30, 10] and part.n_rounds.tolist() == [3, 1]
    assert part._losses.shape == (2, 2 * CONVERGENCE_WINDOW + 1) and part.loss_tol == 0.5
    part.loss[:] = 0
    assert progress.loss.tolist() == [10, 20, 30]


def test_scales_have_steps_and_radii_of_their_sigmas():
    prior = MultiscalePrior(scales_px=(0.5, 1.0, 1.9, 2.0, 5.0, 8.0), strengths=(0.1,) * 6)
    assert prior.steps == (1, 1, 1, 2, 4, 8) and prior.radii == (2, 3, 6, 6, 15, 24)
    for sigma, kernel in zip(prior.scales_px, prior.kernels(), strict=True):
        r = len(kernel) // 2
        wanted = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
        np.testing.assert_allclose(kernel, wanted / np.sqrt((wanted**2).sum()))
    assert gaussian(2.0, 6, unit_sum=True).sum() == pytest.approx(1)
    np.testing.assert_array_equal(prior.amplitude(np.array([4.0, 0.0, -1.0])), [2, 0, 0])


@pytest.mark.parametrize(
    "given, words",
    [
        ({"scales_px": (1.0, 2.0), "strengths": (0.1,)}, "a number for each"),
        ({"scales_px": (), "strengths": ()}, "at least one scale"),
        ({"scales_px": ((1.0,),), "strengths": ((0.1,),)}, "a number for each"),
        ({"scales_px": (0.0,), "strengths": (0.1,)}, "positive numbers only"),
        ({"scales_px": (1.0, 2.0), "strengths": (0.1, 0.0)}, "positive numbers only"),
        ({"hyperprior_weight": 0.0}, "positive numbers only"),
        ({"hyperprior_weight": np.nan}, "positive numbers only"),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        MultiscalePrior(**given)
    assert (
        MultiscalePrior(
            scales_px=(0.5,), strengths=(1e-9,), hyperprior_weight=1e-3
        ).hyperprior_weight
        == 1e-3
    )


def scene(weights, **given):
    known = np.zeros(sum(map(len, weights)))
    return SimpleNamespace(**{"weights": weights, "ties": None, "known_sky": known} | given)


def test_pixels_of_a_scene_are_those_with_a_weight():
    first, second = np.ones((2, 3, 4)), np.zeros((1, 5, 5))
    first[0, 0] = 0
    second[0, 2, 2] = 1e-9
    assert _n_pixels(scene([first, second])) == 24 - 4 + 1
    assert _n_pixels(scene([0 * first])) == 1


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-20])
def test_curvature_is_left_out_where_nothing_is_seen(unit):
    """Under 1e-14 of what the best seen source has in any channel, whatever the unit."""
    power = unit * np.array([[4.0, 1e-13], [1e-15, 0.0]])
    weights = [np.full((1, 2, 2), 0.5), np.zeros((1, 3, 3))]
    for fit_sky in (True, False):
        spectra, sky = _inverse_curvature(
            [scene(weights, spectrum_curvature=power, fit_sky=fit_sky)]
        )
        np.testing.assert_allclose(unit * spectra, [[0.25, 1e13], [0, 0]])
        np.testing.assert_allclose(sky, [[0.5 * fit_sky, 0]])
    known = scene(weights, spectrum_curvature=power, fit_sky=True, known_sky=np.array([6.0, 0.5]))
    np.testing.assert_allclose(_inverse_curvature([known])[1], [[1 / 8, 2]])


def test_where_nothing_is_seen_of_any_source_there_is_no_curvature():
    dark = scene([np.zeros((2, 3, 3))], spectrum_curvature=np.zeros((3, 2)), fit_sky=True)
    spectra, sky = _inverse_curvature([dark])
    assert not spectra.any() and not sky.any()


def test_memory_of_a_scenes_vectors():
    """Twenty-two of the rings and twelve more, of 8 bytes each, and coefficients on every step-th
    pixel; a quarter of each source's with each other, five quarters of it."""
    prior = MultiscalePrior(scales_px=(1.0, 2.0), strengths=(0.1, 0.1))
    one = scene(
        [], profile=[np.zeros((7, 10)), np.zeros((1, 1))], spectrum_curvature=np.zeros((2, 3))
    )
    n = 7 * 10 + 4 * 6 + 1 + 1 + 6  # the last step ends on the last pixel or past it
    blocks = 1.25 * ((94 / 4) ** 2 + (2 / 4) ** 2)
    assert vector_bytes(one, prior) == int(8 * (34 * n + blocks))
