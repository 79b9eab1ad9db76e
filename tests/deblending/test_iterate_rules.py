"""The loop of a batch of fits, with scripted engines: stops, shifts, kept states."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.told import Told, learning

from clresample.deblending import iterate as module
from clresample.deblending.iterate import (
    CHECK_ITERATIONS,
    MIN_GAIN,
    REPACK_FRACTION,
    SHIFT_ITERATIONS,
    iterate,
)
from clresample.paper import run as paper_run


@pytest.fixture(autouse=True)
def no_joint_step(monkeypatch):
    """No sources share light."""
    monkeypatch.setattr(module, "make_joint_step", lambda *given: None)


def test_joint_steps_are_asked_for_in_time_and_again_where_the_last_one_gained(monkeypatch):
    """Of settled fits after FIRST_JOINT_STEP rounds and each JOINT_STEP_ITERATIONS.

    Of converged ones at once.
    """
    made, steps, gains = [], [], {"a": 0.2, "b": 0.6, "c": 0.9}

    def joint_step_of(fit, scene, state, findings):
        made.append((fit.name, scene, state, findings))
        return SimpleNamespace(step=lambda x: (x, 0, 0, gains[fit.name]))

    monkeypatch.setattr(module, "make_joint_step", joint_step_of)
    one = learning([39, 39, 12], converged=[False, False, True], loss_tol=2.5, max_iter=200)
    p, every = one.engine.progress, np.ones(3, bool)
    one.engine.step = lambda given: steps.append({i: step[0] for i, step in given.items()})
    one._take_joint_steps(every)
    assert made == [("c", "scene 2", "state 2", "findings 2")] and not steps  # .9 of 2
    p.n_rounds += 1
    for known in (p.settled, p.tested):  # strengths, and what is clear
        assert len(made) == 1
        known[:2] = True
        one._take_joint_steps(every)
    assert [name for name, *_ in made] == ["c", "a", "b"] and not steps
    p.chi2, p.n_rounds = (lambda: np.array([0.5, 1.0, 1.0])), p.n_rounds + 20
    one._take_joint_steps(every)
    assert not steps  # the losses are what they were
    p.loss = p.loss - 0.51
    p.n_rounds -= 1
    one._take_joint_steps(np.array([True, True, False]))
    assert not steps  # too early
    p.n_rounds += 1
    one._take_joint_steps(np.array([True, True, False]))
    one._take_joint_steps(every)
    assert steps == [{1: "slopes 1"}, {2: "slopes 2"}] and len(made) == 3
    p.n_rounds += 20
    p.loss, p.chi2 = p.loss - np.array([0, 0.6, 0.1]), lambda: np.full(3, 0.1)
    one._take_joint_steps(every)
    assert steps[2:] == [{1: "slopes 1", 2: "slopes 2"}]
    assert made[3:][0][0] == "c"  # it fell by .1 of .9 that was promised
    p.n_rounds, p.loss = p.n_rounds + 20, p.loss - np.array([0, 0.6, 0.1])
    one._take_joint_steps(every)  # and again, with a new matrix
    assert steps[3:] == [{1: "slopes 1"}] and one.joint_steps[2] is None and len(made) == 4
    p.loss, p.converged = p.loss - 1, every
    one.settings.max_iter = int(p.n_rounds.max()) - 1
    one._take_joint_steps(every)
    assert len(steps) == 4  # at the limit


def test_fits_that_are_over_are_left_with_their_present_state():
    """Each with its own status; one that was going on keeps what it had."""
    one = learning([5, 9, 7], converged=[True, False, False], failed=[False, False, True])
    assert one.n_steps == 8 and learning([0, 0]).n_steps == 0
    one.fits[1].status = "interrupted"
    one.settle(np.array([True, True, True]))
    found = [f.ended for f in one.fits]
    assert [ended[3] for ended in found] == ["converged", "interrupted", "diverged"]
    assert found[1][:3] == ("scene 1", "state 1", "findings 1")
    one = learning([5, 9])
    one.settle(np.array([False, True]))
    assert one.fits[0].ended is None and one.fits[1].ended[3] == "iteration limit"


def test_a_round_settles_those_that_it_ends():
    """Not those that had stopped before; at the limit all that go on."""
    one = learning([5, 5, 5], live=[True, True, False])
    p = one.engine.progress

    def round_():
        p.n_rounds += p.live
        p.live[0] = False
        return np.array([True, False, False])

    one.engine.round = round_
    np.testing.assert_array_equal(one.run(), [[1, 2, 3]])
    assert [f.ended is not None for f in one.fits] == [True, False, False]
    assert one.fits[0].losses == [1.0] * CHECK_ITERATIONS and p.n_rounds.tolist() == [6, 10, 5]
    assert p.live.tolist() == [False, True, False]
    one.settings.max_iter = one.n_steps + 2
    one.run()
    assert p.n_rounds.tolist() == [6, 12, 5] and not p.live.any()
    assert one.fits[1].ended is not None and one.fits[2].ended is None


@pytest.mark.parametrize("at_limit", [False, True])
def test_converged_fits_are_shifted_once_more_before_they_end(at_limit, monkeypatch):
    one = learning([2, 2, 2], live=[True, True, False], fit_shifts=True, max_iter=2 + 4 * at_limit)
    one.settings.max_iter = 4 if at_limit else 50
    p = one.engine.progress

    def round_():
        p.n_rounds += p.live
        if p.n_rounds[1] == (5 if at_limit else 4):
            p.live[0], p.converged[0], p.converged[2] = False, True, True
        return np.zeros(3, bool)

    one.engine.round, moved = round_, []
    one._move = lambda which: moved.append(which.tolist())
    one.run()
    assert moved == ([] if at_limit else [[True, False, False]])


def test_shifts_are_made_where_they_gain_part_of_what_ends_a_fit(monkeypatch):
    """In its own measure of misfit; steps are taken ahead from the last ones."""
    one = learning([11, 11, 11], fit_shifts=True, loss_tol=0.2)
    gains = {"scene 0": 1.01, "scene 1": 1.99, "scene 2": 4.01}
    steps = np.array([[0.0, 0.0], [0.1, 0.2]])
    part = MIN_GAIN * 0.2

    def shift_steps(scene, state):
        assert state[-1] == scene[-1]
        return steps, part * gains[scene]

    asked = []
    monkeypatch.setattr(module, "shift_steps", shift_steps)
    monkeypatch.setattr(
        module, "extrapolate", lambda new, last: asked.append(last.max()) or 3 * new
    )
    one.shift()
    assert one.engine.followed == [[True, False, True]] and asked == [9, 9]
    np.testing.assert_array_equal(one.fits[0].shifts, 3 * steps)
    np.testing.assert_array_equal(one.fits[0].last_steps, steps)
    assert not one.fits[1].shifts.any() and one.fits[1].last_steps.max() == 9
    one._move(np.array([False, True, False]))
    assert len(one.engine.followed) == 1  # nothing has moved
    one._move(np.array([False, False, True]))
    assert one.engine.followed[1:] == [[False, False, True]]
    np.testing.assert_array_equal(one.fits[2].shifts, 6 * steps)
    before = len(asked)
    one._move(np.zeros(3, bool))
    assert len(asked) == before
    one.engine.progress.n_rounds[:] = SHIFT_ITERATIONS + 2
    one.shift()  # not every round
    one.engine.progress.n_rounds[:] = SHIFT_ITERATIONS + 1
    one.settings.fit_shifts = False
    one.shift()
    assert len(asked) == before


def test_fits_that_go_on_leave_a_batch_of_which_a_quarter_has_stopped():
    assert REPACK_FRACTION == 0.25
    one = learning([3] * 3, live=[True, False, True])
    one.engine.subset = lambda keep: SimpleNamespace(kept=keep.tolist())
    rest = one.repacked()
    assert rest is not one and rest.engine.kept == [0, 2]
    assert [f.name for f in rest.fits] == ["a", "c"]


class Engine:
    """One under another prior: each iteration lowers fit i's loss by i + 1."""

    def __init__(self, n, n_steps=0):
        self.n_steps, self.scenes = n_steps, [f"scene {i}" for i in range(n)]
        self.followed = 0

    def run(self, n):
        self.n_steps += n
        return np.arange(n)[:, None] * -np.arange(1.0, len(self.scenes) + 1)

    def states(self, kept=False):
        return [f"{'kept' if kept else 'state'} {i}" for i in range(len(self.scenes))]

    def best_losses(self):
        return np.arange(len(self.scenes)) + 0.25

    def final_losses(self):
        return np.arange(len(self.scenes)) + 0.5

    def update_shifts(self):
        self.followed += 1


RUNNING = paper_run.AmsgradRun


def running(n, *, live=None, n_steps=0, **settings):
    one = object.__new__(RUNNING)
    one.tracks, one.engine = [Told(c) for c in "abcdefgh"[:n]], Engine(n, n_steps)
    one.fits = one.tracks
    one.live = np.ones(n, bool) if live is None else np.array(live)
    one.settings = SimpleNamespace(**({"max_iter": 100, "fit_shifts": False} | settings))
    one.device = one.dtype = None
    for f in one.fits:
        f.stopped = lambda losses, f=f: f.losses.extend(losses) or f.name == "b"
    return one


def test_other_engines_run_a_few_iterations_and_settle_who_stops():
    one = running(3, live=[True, True, False], max_iter=CHECK_ITERATIONS + 2)
    losses = one.run()
    assert losses.shape == (CHECK_ITERATIONS, 3) and one.live.tolist() == [True, False, False]
    assert (
        one.fits[0].losses == (-np.arange(CHECK_ITERATIONS)).tolist() and one.fits[2].losses == []
    )
    assert one.fits[1].ended == (1.5, "scene 1", "state 1")
    assert one.fits[1].best == (1.25, "scene 1", "kept 1")
    assert one.fits[0].ended is None and one.fits[0].best is None
    assert one.run().shape == (2, 3)  # and then no more
    assert not one.live.any() and one.fits[0].ended == (0.5, "scene 0", "state 0")
    assert one.fits[2].ended is None


@pytest.mark.parametrize(
    "fit_shifts, n_steps",
    [(True, SHIFT_ITERATIONS), (True, SHIFT_ITERATIONS - 1), (False, SHIFT_ITERATIONS)],
)
def test_other_engines_shift_every_few_iterations(fit_shifts, n_steps, monkeypatch):
    one = running(3, live=[True, False, True], fit_shifts=fit_shifts, n_steps=n_steps)
    monkeypatch.setattr(paper_run, "shift_steps", lambda scene, state: (np.full((2, 2), 0.5), 1.0))
    one.fits[0].shifts = np.ones((2, 2))
    one.shift()
    due = fit_shifts and n_steps == SHIFT_ITERATIONS
    assert one.engine.followed == due
    assert [f.shifts.max() for f in one.fits] == ([1.5, 0, 0.5] if due else [1, 0, 0])
    assert (one.fits[0].best == (0.25, "scene 0", "kept 0")) == due and one.fits[1].best is None


def test_ctrl_c_settles_those_that_go_on(monkeypatch):
    one = running(3, live=[True, False, True])
    one.run = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    clock = iter([10.0, 13.0, 13.0, 13.0])
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    iterate(one.fits, SimpleNamespace(start_run=lambda *_: one, max_iter=9), None, None)
    assert [f.status == "interrupted" for f in one.fits] == [True, False, True]
    assert [f.ended is not None for f in one.fits] == [True, False, True]
    assert [f.seconds for f in one.fits] == [{"fit": 1.0}] * 3  # shared among them


def test_a_run_ends_when_no_fit_goes_on_or_at_the_limit(monkeypatch):
    """And tells how far it is."""
    for max_iter, wanted in ((100, [5, 10]), (7, [5, 7]), (0, [])):
        one, seen, calls = running(2, max_iter=max_iter), [], []
        one.fits[0].stopped = lambda losses, one=one: one.n_steps >= 10
        one.shift, one.repacked = lambda calls=calls: calls.append(1), lambda one=one: one
        settings = SimpleNamespace(start_run=lambda *_, one=one: one, max_iter=max_iter)
        iterate(one.fits, settings, None, None, lambda n, loss, seen=seen: seen.append((n, loss)))
        assert [n for n, _ in seen] == wanted and len(calls) == max(len(wanted) - 1, 0)
        if seen:
            np.testing.assert_array_equal(seen[0][1], [-4, -8])
