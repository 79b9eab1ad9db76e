"""Fits that end before they have converged, since their scene needs more components."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.told import learning, named

from clresample.deblending import iterate as room
from clresample.deblending.ended import Ended
from clresample.deblending.refit import two_component_fit
from clresample.deblending.refit.colour_gradient import GradientTest
from clresample.deblending.settings import Settings


def test_fits_with_clear_structure_are_offered_once_it_is_known():
    """Once, with their present state; those that are taken end there, and take no more steps."""
    one = learning([5, 5, 5])
    p, taken, exchanged = one.engine.progress, [], []
    one.engine.strengths = SimpleNamespace(significant_scenes=lambda: np.array([True, True, False]))

    def takes_over(fit):
        taken.append((fit.name, fit.ended))
        return fit.name == "b"

    def round_():
        p.n_rounds += p.live
        p.tested |= p.n_rounds > 6
        return np.zeros(3, bool)

    one.engine.round, one.stop_for_refit = round_, takes_over
    one._take_joint_steps = lambda which: exchanged.append(which.tolist())
    one.run()
    assert [name for name, _ in taken] == ["a", "b"]
    assert taken[1][1] == ("scene 1", "state 1", "findings 1", "iteration limit")
    assert exchanged == [[True] * 3] + [[True, False, True]] * 4
    assert p.n_rounds.tolist() == [10, 7, 10] and p.live.tolist() == [True, False, True]
    assert [f.status for f in one.fits] == [
        "iteration limit",
        "stopped for refit",
        "iteration limit",
    ]
    one.engine.subset = lambda keep: SimpleNamespace(
        progress=SimpleNamespace(live=np.ones(2, bool))
    )
    assert one.repacked().stop_for_refit is takes_over


def test_ctrl_c_interrupts_fits_that_wait_to_be_taken_over(monkeypatch):
    one = learning([5, 5])
    one.fits[0].status, one.engine.progress.live[0] = "stopped for refit", False

    def stopped():
        raise KeyboardInterrupt

    one.run = stopped
    settings = SimpleNamespace(start_run=lambda *_: one, max_iter=100)
    room.iterate(one.fits, settings, None, None)
    assert [f.status for f in one.fits] == ["interrupted"] * 2


def test_a_fit_that_is_taken_over_goes_on_unless_the_second_one_is_surely_better(monkeypatch):
    """Then with the shifts that it had, and no less time; the better one is kept in the end.

    Second ones may take twice as many iterations.
    """
    firsts = [named(k, Ended.REFIT, shifts=float(k)) for k in range(4)]
    again = {k: named(10 + k, shifts=9.0, of=firsts[k]) for k in (0, 1, 2)}
    monkeypatch.setattr(two_component_fit, "start_refits", lambda fits: again)
    runs = []

    def iterate(fits, settings, device, dtype, progress):
        runs.append((fits, settings.max_iter, [fit.at["shifts"] for fit in fits]))
        progress(3, 0.5)
        for fit in fits:
            fit.seconds["fit"] = 2.0
            fit.losses.append(0.5)

    far_better, kept_ones = {10}, {10, 11}
    monkeypatch.setattr(two_component_fit, "iterate", iterate)
    monkeypatch.setattr(two_component_fit, "_is_far_better", lambda new, _: new.name in far_better)
    monkeypatch.setattr(two_component_fit, "_is_kept", lambda new, _: new.name in kept_ones)
    told = []
    kept = two_component_fit.refit_two_components(
        firsts, Settings(max_iter=50), None, None, lambda *n: told.append(n)
    )
    assert runs[0][:2] == (list(again.values()), 100)
    assert runs[1:] == [(firsts[1:], 50, [1, 2, 3])]
    assert told == [(4, 0.5), (6, 0.5)]  # after one iteration of the first, and two of the second
    assert [one.name for one in kept] == [10, 11, 2, 3]
    assert [one.at["shifts"] for one in firsts] == [9, 9, 2, 3]
    assert [one.seconds["fit"] for one in kept] == [3, 5, 3, 3]
    # at its limit one that goes on is neither that nor interrupted
    assert [one.status for one in firsts] == [Ended.REFIT] + ["iteration limit"] * 3
    # the loss of the state in which it goes on is there once
    assert [one.losses for one in firsts] == [[1.0]] + [[0.5]] * 3


@pytest.mark.parametrize("begins", [True, False])
def test_a_fit_that_is_taken_over_goes_on_where_the_second_one_fails(begins, monkeypatch):
    """With a message, and the shifts that it had."""
    first, ended = named(0, Ended.REFIT, shifts=3.0), []

    def fails(*_):
        raise ValueError("no memory")

    def iterate(fits, *given):
        if fits[0].name:
            fits[0].shift(9.0)
            fails()
        ended.append((fits[0].name, fits[0].at["shifts"]))
        fits[0].status = "converged"

    monkeypatch.setattr(
        two_component_fit,
        "start_refits",
        lambda fits: {0: named(1, of=first)} if begins else fails(),
    )
    monkeypatch.setattr(two_component_fit, "iterate", iterate)
    assert two_component_fit.refit_two_components([first], Settings(), None, None) == [first]
    assert ended == [(0, 3.0)] and "no memory" in first.messages[0]


@pytest.mark.parametrize("when", ["second", "first"])
def test_a_fit_that_was_taken_over_and_interrupted_says_so(when, monkeypatch):
    """In the second fit, or when it goes on after that."""
    first = named(0, Ended.REFIT)
    new = named(1, of=first)
    monkeypatch.setattr(two_component_fit, "start_refits", lambda fits: {0: new})
    monkeypatch.setattr(
        two_component_fit,
        "iterate",
        lambda fits, *_: [fit.interrupt() for fit in fits if (fit is new) == (when == "second")],
    )
    for name in ("_is_far_better", "_is_kept"):
        monkeypatch.setattr(two_component_fit, name, lambda *_: False)
    assert two_component_fit.refit_two_components([first], Settings(), None, None) == [first]
    assert first.status == Ended.INTERRUPTED


@pytest.mark.parametrize("evidence", [None, [1.9], [2.6, 2.8]])
def test_a_scene_is_taken_over_where_a_gradient_is_clear(evidence, monkeypatch):
    asked = evidence and GradientTest(np.arange(len(evidence)), np.array(evidence), np.ones((3, 2)))
    monkeypatch.setattr(two_component_fit, "run_gradient_tests", lambda fits: [asked])
    assert two_component_fit.needs_second_component("fit") == (evidence == [2.6, 2.8])


def test_a_fit_goes_on_where_nobody_can_tell_what_it_needs(monkeypatch):
    def ask(fits):
        raise MemoryError

    monkeypatch.setattr(two_component_fit, "run_gradient_tests", ask)
    assert not two_component_fit.needs_second_component("fit")
