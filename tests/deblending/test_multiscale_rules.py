"""Decisions of the multi-scale solver, each in a table: trials, strengths, convergence, memory."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.progress import falls

from clresample.deblending.solver.multiscale import lbfgs_control
from clresample.deblending.solver.multiscale.engine import (
    MultiscaleEngine,
    _inverse_curvature,
    _n_pixels,
    vector_bytes,
)
from clresample.deblending.solver.multiscale.lbfgs_control import LbfgsControl
from clresample.deblending.solver.multiscale.lbfgs_pairs import LbfgsPairs
from clresample.deblending.solver.multiscale.lbfgs_steps import AGAIN, NEXT, REST, STAY, TRY
from clresample.deblending.solver.multiscale.prior import MultiscalePrior, gaussian

NAN = np.nan


def begun(*losses, settled=True, n_pixels=1000):
    """The LbfgsControl of scenes whose first losses are these."""
    control, n = LbfgsControl(len(losses), 0.5, [n_pixels] * len(losses)), len(losses)
    accepted, stepped = control.accept_trials(np.array(losses, float), np.zeros(n))
    assert accepted.all() and not stepped.any()
    mode, length, bare = control.next_actions(accepted)
    assert mode.tolist() == [NEXT] * n and length.tolist() == [1] * n and not bare.any()
    assert control.n_iterations.tolist() == [0] * n
    control.settled[:] = settled
    return control


def test_a_start_without_a_loss_has_failed():
    control = LbfgsControl(3, 0.5, [10, 10, 10])
    accepted, _ = control.accept_trials(np.array([5.0, NAN, np.inf]), np.zeros(3))
    assert accepted.tolist() == control.live.tolist() == [True, False, False]
    assert control.failed.tolist() == [False, True, True]
    assert control.n_rounds.tolist() == [1, 1, 1]
    assert control.next_actions(accepted)[0].tolist() == [NEXT, REST, REST]
    control.accept_trials(np.array([4.0, 5.0, 5.0]), np.array([-1.0, 0.0, 0.0]))
    assert control.n_rounds.tolist() == [2, 1, 1]  # finished scenes are not counted


# Rounds of scenes that begin at a loss of 10: the trial's loss and slope, the action that follows
# and the length of its step (None: any). A loss a with slope -s shortens a step to its parabola's
# minimum, s / (2 (a - 10 + s)), within limits.
REFUSED = [(11, -1, TRY, None)] * 7
TRIALS = {
    "accepted above 1e-4 of the slope": [(9.989, -100, NEXT, 1)],
    "refused below that": [(9.991, -100, TRY, 0.5)],
    "no step uphill": [(9.0, 1, AGAIN, 1)],
    "no loss": [(NAN, -100, TRY, 0.1)],
    "parabola": [(11, -4, TRY, 0.4), (11, -4, TRY, 0.16), (5, -4, NEXT, 1)],
    "steeper": [(16, -4, TRY, 0.2), (16, -4, TRY, 0.04), (5, -4, NEXT, 1)],
    "shortest": [(100, -4, TRY, 0.1), (100, -4, TRY, 0.01), (5, -4, NEXT, 1)],
    "longest": [(10.01, -4, TRY, 4 / 8.02), (10.01, -4, TRY, (4 / 8.02) ** 2), (5, -4, NEXT, 1)],
    "any unit": [(5, -4, NEXT, 1), (5.0001, -0.0004, TRY, 0.4)],
    "uphill, then a gain": [(11, 0.0, AGAIN, 1), (9, -1, NEXT, 1), (9.5, 1, AGAIN, 1)],
    "uphill twice": [(11, 0.0, AGAIN, 1), (9.5, 1, REST, None)],
    "eight trials, and eight more": [*REFUSED, (11, -1, AGAIN, 1), *REFUSED, (11, -1, REST, None)],
}
# With unsettled strengths, these are updated where the scene would otherwise end.
TRIALS |= {
    f"{name}, unsettled": [*TRIALS[name][:-1], (*TRIALS[name][-1][:2], STAY, None)]
    for name in ("uphill twice", "eight trials, and eight more")
}


@pytest.mark.parametrize("beside", ["", "parabola", "no step uphill"])
@pytest.mark.parametrize("name", TRIALS)
def test_trials_are_accepted_shortened_or_given_up(name, beside):
    """Pairs are dropped with AGAIN alone. Scenes of a batch do not affect each other."""
    scripts = [TRIALS[name], *([TRIALS[beside]] if beside else [])]
    control = begun(*[10] * len(scripts), settled=False)
    control.settled[0] = "unsettled" not in name
    for k, (loss, _, action, step) in enumerate(TRIALS[name]):
        rounds = [script[min(k, len(script) - 1)] for script in scripts]
        before, n_before = control.loss[0], control.n_iterations[0]
        trials = [np.array(values, float) for values in list(zip(*rounds, strict=True))[:2]]
        accepted, stepped = control.accept_trials(*trials)
        mode, length, bare = control.next_actions(accepted)
        assert mode[0] == action and bare[0] == (action == AGAIN) and not control.failed[0]
        assert accepted[0] == stepped[0] == (action == NEXT)
        assert control.loss[0] == (loss if accepted[0] else before)
        assert control.n_iterations[0] == n_before + accepted[0]
        assert step is None or length[0] == pytest.approx(step, rel=1e-4)
        assert control.converged[0] == (action == REST) != control.live[0]
    if action == STAY:  # its next trial is where it is, and gives no step
        losses = np.full(len(scripts), 12.0)
        accepted, stepped = control.accept_trials(losses, np.zeros(len(losses)))
        assert accepted[0] and not stepped[0] and control.loss[0] == 12
        assert control.strengths_due(accepted)[0]  # also in rounds that are no multiple of four
    if action == REST:
        assert not control.accept_trials(np.full(len(scripts), 9.0), -np.ones(len(scripts)))[0][0]
        assert control.loss[0] == 10


@pytest.mark.parametrize("chi2", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("total, ends", [(0.45, True), (0.55, False)])
def test_a_fit_has_converged_when_five_iterations_gain_too_little(total, ends, chi2):
    """`loss_tol`, times chi2 per pixel where that is above 1, after five that gained far more.
    Unsettled strengths prevent it; an accepted trial is kept."""
    unit = max(chi2, 1)
    now = 0.5 * chi2 * 1000 + 10 * unit
    control = begun(now, now)
    control.settled[1] = False
    for i in range(10):
        now -= (10 if i < 5 else total) * unit / 5
        accepted, _ = control.accept_trials(np.array([now, now]), np.full(2, -1e-9))
        mode, _, _ = control.next_actions(accepted)
        assert control.live.all() or (i == 9 and ends)
    assert control.converged.tolist() == [ends, False] and mode.tolist() == [NEXT, NEXT]


@pytest.mark.parametrize(
    "n, before, now, n_rounds, refused, ends",
    [
        (5, 0.2, 0.03, 49, 0, True),
        (5, 0.2, 0.05, 49, 0, False),
        (10, 0.14, 0.06, 50, 40, True),
        (10, 0.14, 0.06, 50, 41, False),
        (10, 0.14, 0.06, 49, 0, False),
        (10, 0.13, 0.06, 50, 0, False),
        (10, 5.0, 0.11, 50, 0, False),
        (5, 0.00095, 0.0009, 49, 0, True),
        (5, 5.0, 0.11, 50, 0, False),
    ],
)
def test_a_fit_goes_on_while_a_series_of_its_falls_promises_more(
    n, before, now, n_rounds, refused, ends
):
    """Falls in each of 2n iterations, loss_tol 0.5: n now, n now^2 / (before - now) later, which
    may be a tenth of it, or all of it late; none below a hundredth of it counts."""
    control = begun(10)
    control.n_rounds[:], control._refused[:] = n_rounds, refused
    control._losses[0, 2 * n :: -1] = 10 + np.cumsum([0, *[-before] * n, *[-now] * n])
    control.next_actions(np.array([True]))
    assert control.converged.tolist() == [ends]


@pytest.mark.parametrize(
    "n_determined, tested, fall, ends",
    [
        (0, True, 1, False),
        (50, True, 1, False),
        (90, True, 1, True),
        (90, False, 1, False),
        (1000, True, 1.2, True),
        (1000, True, 1.4, False),
    ],
)
def test_a_source_alone_converges_by_what_its_data_determine(n_determined, tested, fall, ends):
    """A fall over five iterations after one twice as large, loss_tol 0.5: with 90 parameters it is
    1.8, and 2 with many. It has looked for significant structure by then."""
    control = begun(10)
    control.n_determined[:], control.tested[:], control.n_rounds[:] = n_determined, tested, 60
    steps = np.repeat([-10, -4, -2, -1], 5) * fall / 5
    control._losses[0, 20::-1] = 10 + np.append(0, np.cumsum(steps))
    control.next_actions(np.array([True]))
    assert control.converged.tolist() == [ends]


@pytest.mark.parametrize(
    "n_pixels, drops, moved, due",
    [
        (10_000, [5] * 40, [0.11] * 29 + [0.09] * 11, [16, 24, 32]),
        (100, [9, 9, 9, 3, 1, 0.5, 0.1, 0.1, 9, 0.1, 0.1, 0.1, 0.1], [0.2] * 13, [8, 12]),
    ],
)
def test_strengths_are_updated_until_they_have_settled(n_pixels, drops, moved, due):
    """After sixteen rounds and then every eighth; at once where three iterations have gained less
    than 5, in rounds that are multiples of four, and not again before three more."""
    names = "FIRST_STRENGTH_ROUND", "STRENGTH_ROUNDS", "MAX_LOG_STRENGTH_CHANGE", "COMMON_ROUNDS"
    assert [getattr(lbfgs_control, name) for name in names] == [16, 8, 0.1, 4]
    control, found, loss = LbfgsControl(1, 0.5, [n_pixels]), [], 1000.0 * n_pixels / 10_000 + 90
    for i, (drop, change) in enumerate(zip(drops, moved, strict=True), 1):
        loss -= drop
        accepted, _ = control.accept_trials(np.array([loss]), np.array([-1e-6]))
        if control.strengths_due(accepted)[0]:
            found.append(i)
            control.record_strengths(np.array([True]), np.array([change]), np.array([0.0]))
            assert control.settled[0] == (change < 0.1)
        control.next_actions(accepted)
    assert found == due


def test_a_changed_loss_is_evaluated_where_the_scene_is():
    """After a shift, or new strengths: converged scenes go on, and past falls do not count."""
    control = begun(10, 10, 10, 10)
    control.settled[3] = False
    falls(control, 0, 0, 0, 0)
    control.next_actions(np.array([True, True, False, True]))
    assert control.converged.tolist() == [True, True, False, False]
    control.refresh_loss(np.array([True, False, True, False]))
    control.record_strengths(np.arange(4) == 3, np.full(4, 0.05), np.array([9, NAN, 9, 0.25]))
    assert control.live.tolist() == [True, False, True, True]
    assert control.converged.tolist() == [False, True, False, False]
    assert control.settled.all() and control.loss.tolist() == [10, 10, 10, 10.25]
    accepted, stepped = control.accept_trials(np.full(4, 10.0), np.zeros(4))
    assert accepted.tolist() == [True, False, True, False] and not stepped.any()
    for i in range(1, 7):  # the others converge after five more; the last one falls by 0.25 first
        accepted, _ = control.accept_trials(np.full(4, 10 - 1e-4 * i), np.full(4, -1e-6))
        control.next_actions(accepted)
        assert control.converged.tolist() == [i > 4, True, i > 4, i > 5]


def test_scenes_can_be_taken_out_of_a_batch():
    control = begun(10, 20, 30)
    control.n_rounds[:] = [1, 2, 3]
    part = control.take(np.array([2, 0]))
    assert part.loss.tolist() == [30, 10] and part.n_rounds.tolist() == [3, 1]
    assert part.loss_tol == 0.5 and part.chi2().tolist() == [1, 1]
    part.loss[:] = 0
    assert control.loss.tolist() == [10, 20, 30]


def test_exchange_directions_are_renewed_and_earlier_pairs_dropped():
    """Of scenes that are due; pairs stay where there were no directions and are none now."""
    one, taken, n = object.__new__(MultiscaleEngine), [], 4
    one.pairs, one._exchanges = LbfgsPairs(n, 2), [[], ["old 1"], [], ["old 3"]]
    one.pairs.take(np.arange(n), np.ones((n, 3)), np.ones((n, 3)))
    due = np.array([True, True, True, False])
    found = {0: ["new 0"], 1: [], 2: []}
    one.progress = SimpleNamespace(n_rounds=np.zeros(n, int), exchanges_due=lambda: due)
    one.strengths = SimpleNamespace(
        take_blocks=lambda _: None,
        find_exchanges=lambda which, states: found if which is due and states is due else None,
        schedule=SimpleNamespace(blocks="blocks"),
    )
    one.states = lambda which: which
    one.steps = SimpleNamespace(take_blocks=lambda *given: taken.append(given))
    forgotten = []
    one._trial = SimpleNamespace(forget=lambda: forgotten.append(len(taken)))
    one._precondition()
    assert forgotten == [0]  # the launches of a trial are others then, and hold the old blocks
    assert taken == [("blocks", [["new 0"], [], [], ["old 3"]])]
    assert one.pairs.count.tolist() == [0, 0, 1, 1]
    due[:] = False
    one._precondition()
    assert len(taken) == 1 and one.pairs.count.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize("due", [(True, False), (False, True), (True, True), (False, False)])
def test_scenes_update_strengths_when_due_though_others_do_not(due):
    one, learned, sums = object.__new__(MultiscaleEngine), [], np.zeros((2, 3, 4))
    one.progress = SimpleNamespace(
        accept_trials=lambda *_: (np.ones(2, bool), np.zeros(2, bool)),
        strengths_due=lambda _: np.array(due),
        significance_due=lambda _: np.zeros(2, bool),
        next_actions=lambda _: (None, None, None),
    )
    one.pairs = SimpleNamespace(
        take=lambda *_: None, forget=lambda _: None, coefficients=lambda *_: (None, None, None)
    )
    one.steps = SimpleNamespace(follow=lambda *_: None, advance=lambda *_: None)
    one._precondition = lambda: None
    one._evaluate = lambda: (sums, None, None)
    one._learn = lambda which: learned.append(tuple(which.tolist())) or sums
    one.round()
    assert learned == ([due] if any(due) else [])


def test_exchange_directions_are_found_after_twice_as_many_rounds_each_time():
    control, due = begun(1.0, 1.0), []
    control.live[1] = False
    for n in range(400):
        control.n_rounds[:] = n
        if control.exchanges_due().any():
            assert control.exchanges_due().tolist() == [True, False]
            due.append(n)
    assert due == [40, 80, 160, 320]


@pytest.mark.parametrize("external", [True, False])
def test_a_rejected_external_step_does_not_delay_a_late_end(external):
    """Falls that end a fit 50 rounds after its start, but not soon after a step of its own."""
    control = begun(10)
    control.n_rounds[:] = 50
    if external:
        control.resume(np.array([True]))
    accepted, _ = control.accept_trials(np.array([11.0]), np.array([-1.0]))
    control.next_actions(accepted)
    control._losses[0, 20::-1] = 10 + np.cumsum([0, *[-0.14] * 10, *[-0.06] * 10])
    control.loss[:] = control._losses[0, 0]
    accepted, stepped = control.accept_trials(control.loss - 0.06, np.array([-0.1]))
    assert accepted.all() and stepped.all()
    control.next_actions(accepted)
    assert control.converged.tolist() == [external]
    control.converged[:], control.live[:], control.n_rounds[:] = False, True, 90
    control.accept_trials(np.array([11.0]), np.array([-1.0]))
    control.next_actions(np.array([False]))
    assert control._refused[0] == 91  # the next step is its own again


def test_a_resumed_scene_converges_again_unless_the_step_gains():
    """0.1 and 1 in one step, of which 0.5 are loss_tol; falls before were far larger, then none."""
    control = begun(10, 10)
    control.converged[:], control.live[:] = True, False
    control._losses[:] = np.where(np.arange(control._losses.shape[1]) > 5, 100, 10)
    control.resume(np.ones(2, bool))
    assert control.live.all() and not control.converged.any()
    accepted, _ = control.accept_trials(np.array([9.9, 9.0]), -np.ones(2))
    control.next_actions(accepted)
    assert control.converged.tolist() == [True, False]


def test_scales_have_steps_and_radii_of_their_sigmas():
    prior = MultiscalePrior(scales_px=(0.5, 1.0, 1.9, 2.0, 5.0, 8.0), strengths=(0.1,) * 6)
    assert prior.steps == (1, 1, 1, 2, 4, 8) and prior.radii == (2, 3, 6, 6, 15, 24)
    for sigma, kernel in zip(prior.scales_px, prior.kernels(), strict=True):
        r = len(kernel) // 2
        wanted = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
        np.testing.assert_allclose(kernel, wanted / np.sqrt((wanted**2).sum()))
    assert gaussian(2.0, 6, unit_sum=True).sum() == pytest.approx(1)
    np.testing.assert_array_equal(prior.amplitude(np.array([4.0, 0.0, -1.0])), [2, 0, 0])


ONE_SCALE = {"scales_px": (0.5,), "strengths": (1e-9,), "hyperprior_weight": 1e-3}


@pytest.mark.parametrize(
    "given, words",
    [
        ({"scales_px": (1.0, 2.0)}, "a number for each"),
        ({"scales_px": (), "strengths": ()}, "at least one scale"),
        ({"scales_px": ((1.0,),), "strengths": ((0.1,),)}, "a number for each"),
        ({"scales_px": (0.0,)}, "positive numbers only"),
        ({"scales_px": (1.0, 2.0), "strengths": (0.1, 0.0)}, "positive numbers only"),
        ({"hyperprior_weight": 0.0}, "positive numbers only"),
        ({"hyperprior_weight": NAN}, "positive numbers only"),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(given, words):
    assert MultiscalePrior(**ONE_SCALE).hyperprior_weight == 1e-3
    with pytest.raises(ValueError, match=words):
        MultiscalePrior(**ONE_SCALE | given)


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
@pytest.mark.parametrize(
    "fit_sky, known_sky, sky",
    [(True, (0, 0), (0.5, 0)), (False, (0, 0), (0, 0)), (True, (6, 0.5), (1 / 8, 2))],
)
def test_inverse_curvature_is_0_where_nothing_is_observed(unit, fit_sky, known_sky, sky):
    """Under 1e-14 of the best observed source's in any channel, whatever the unit."""
    given = {"fit_sky": fit_sky, "known_sky": np.array(known_sky)}
    one = scene([np.full((1, 2, 2), 0.5), np.zeros((1, 3, 3))], **given)
    for power, wanted in (
        (np.array([[4.0, 1e-13], [1e-15, 0.0]]), [[0.25, 1e13], [0, 0]]),
        (np.zeros((3, 2)), np.zeros((3, 2))),
    ):
        one.spectrum_curvature = unit * power
        spectra, found = _inverse_curvature([one])
        np.testing.assert_allclose(unit * spectra, wanted)
        np.testing.assert_allclose(found, [sky])


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
