"""Fits on their way: parts, failures, interruptions of many, and with which state each ends."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.told import CPU

from clresample.deblending import batch, fit as fit_module
from clresample.deblending.batch import _BatchRunner
from clresample.deblending.blend import Failure
from clresample.deblending.fit import Fit
from clresample.paper.run import FitTrack


class Named(SimpleNamespace):
    """A fit that is no more than its name; those called bad fail together with all others."""

    def restart(self):
        self.restarts = getattr(self, "restarts", 0) + 1

    def result(self, seen):
        if self.name == "late":
            raise ValueError("no result")
        return f"{self.name} {seen}"


def many_of(names, monkeypatch, *, memory=100, **sizes):
    """_BatchRunner on their way and the group (index, Fit) of these names."""
    many = object.__new__(_BatchRunner)
    many.blends, many.done, many.memory = list(names), [None] * len(names), memory
    many.settings = many.dtype = None
    many.device = CPU
    many.warned = {}
    group = [
        (
            i,
            Named(
                name=name,
                blend=name,
                status="going",
                undetected=[1] * (name == "dim"),
                problems=[],
                settings=None,
            ),
        )
        for i, name in enumerate(names)
    ]

    def stop(fits, *_, takes_over=None):
        if any(fit.name == "bad" for fit in fits):
            raise ValueError("bad data")
        if any(fit.name == "stop" for fit in fits):
            for fit in fits:
                fit.status = "interrupted"

    calls = []
    monkeypatch.setattr(batch, "start_fits", stop)
    monkeypatch.setattr(batch, "iterate", stop)
    monkeypatch.setattr(
        batch, "refit_two_components", lambda fits, *_: calls.append(len(fits)) or fits
    )
    monkeypatch.setattr(batch, "render_fits", lambda fits: [f"seen {len(fits)}"] * len(fits))
    monkeypatch.setattr(batch, "scene_bytes", lambda fit: sizes.get(fit.name, 1))
    return many, group, calls


def test_those_that_can_begin_though_others_cannot(monkeypatch):
    many, group, _ = many_of(["a", "bad", "dim"], monkeypatch)
    begun = many._begin(group)
    assert [fit.name for _, fit in begun] == ["a", "dim"] and many.warned == {
        0: ([], []),
        2: ([1], []),
    }
    assert [done is None for done in many.done] == [True, False, True]
    assert many.done[1].blend == "bad" and "bad data" in many.done[1].reason


def test_one_that_fails_is_fitted_apart_from_the_others(monkeypatch):
    many, group, seconds = many_of(["a", "bad", "late"], monkeypatch)
    assert many._fit(group) is False
    assert many.done[0] == "a seen 1" and seconds == [1, 1]
    assert all(isinstance(done, Failure) for done in many.done[1:])
    assert "bad data" in many.done[1].reason and "no result" in many.done[2].reason
    many, group, seconds = many_of(["a", "b"], monkeypatch)
    assert many._fit(group) is False and many.done == ["a seen 2", "b seen 2"] and seconds == [2]


def test_a_group_that_fails_is_halved(monkeypatch):
    """Of 64 fits the bad one is found in six steps, and 1, 2, 4 ... others go on together."""
    many, group, sizes = many_of([*"a" * 40, "bad", *"b" * 23], monkeypatch)
    assert many._fit(group) is False
    assert sorted(sizes) == [1, 2, 4, 8, 16, 32]
    assert [i for i, done in enumerate(many.done) if isinstance(done, Failure)] == [40]
    assert [fit.restarts for _, fit in group] == [1] * 32 + [3] * 8 + [6] + [6] + [5] * 2 + [
        4
    ] * 4 + [2] * 16


def test_nothing_more_is_begun_once_a_fit_was_interrupted(monkeypatch):
    """No second components, and no later part."""
    many, group, seconds = many_of(["a", "stop", "c"], monkeypatch, memory=2)
    assert many._fit(group) is True
    assert many.done == ["a seen 2", "stop seen 2", None] and seconds == []
    many, group, seconds = many_of(["bad", "a", "stop", "c"], monkeypatch)
    assert many._fit(group) is True  # by halves
    assert isinstance(many.done[0], Failure)
    assert many.done[1:] == ["a seen 1", "stop seen 2", "c seen 2"]
    assert seconds == [1]


def going(status="iteration limit"):
    """A fit on its way at shift 1, whose best state so far is of loss 5 at shift 0."""
    one = object.__new__(Fit)
    one.views = [SimpleNamespace(op=SimpleNamespace(shift=np.zeros(2))) for _ in range(2)]
    one.losses, one.status = [9.0], status
    track = FitTrack(one, 1e-3)
    track.keep_best(5.0, "best scene", "best state")
    one.shift(np.ones((2, 2)))
    return one, track


@pytest.mark.parametrize(
    "loss, status, kept",
    [
        (4.9, "iteration limit", "present"),
        (5.0, "converged", "present"),
        (5.1, "converged", "best"),
        (4.9, "interrupted", "best"),  # it may be half-way through an iteration
        (np.nan, "diverged", "best"),
    ],
)
def test_a_fit_ends_with_its_best_state_and_the_shifts_of_that(loss, status, kept):
    one, track = going(status)
    track.store_final(loss, "present scene", "present state")
    assert (one.scene, one.state) == (f"{kept} scene", f"{kept} state")
    assert one.losses == [9.0, loss if kept == "present" else 5.0]
    assert one.shifts.tolist() == [[float(kept == "present")] * 2] * 2


def test_only_better_states_are_remembered():
    one, track = going()
    for loss in (5.0, 6.0, np.nan):
        track.keep_best(loss, "other scene", "other state")
    track.store_final(7.0, "present scene", "present state")
    assert one.state == "best state"
    track.keep_best(4.0, "new scene", "new state")
    one.shift(np.full((2, 2), 2.0))
    track.store_final(7.0, "present scene", "present state")
    assert one.state == "new state" and one.shifts.tolist() == [[0.0, 0.0]] * 2
    none, _ = going("interrupted")
    none.scene, none.state = "first scene", "first state"
    FitTrack(none, 1e-3).store_final(1.0, "present scene", "present state")
    assert none.state == "first state" and none.losses == [9.0]


def test_losses_that_come_in_say_whether_a_fit_goes_on():
    one, track = going()
    assert track.stopped(np.array([8.0, 7.0])) is False
    assert one.losses == [9.0, 8.0, 7.0] and one.status == "iteration limit"
    assert track.stopped(np.array([6.0, np.nan])) is True and one.status == "diverged"
    one.end("scene", "state", "findings", "converged")
    assert (one.scene, one.state, one.strength_estimates) == ("scene", "state", "findings")
    assert one.status == "converged"


def test_morphologies_have_a_maximum_of_one():
    """Of those that are 0 everywhere, 0."""
    morph = [
        np.array([[0.5, 0.25]], np.float32),
        np.zeros((2, 2), np.float32),
        np.full((1, 1), 4.0),
    ]
    state = SimpleNamespace(morph=morph)
    assert fit_module._peaks(state).tolist() == [0.5, 1.0, 4.0]
    scaled = fit_module._scaled(state)
    assert [m.tolist() for m in scaled] == [[[1.0, 0.5]], [[0, 0], [0, 0]], [[1.0]]]
    assert {m.dtype for m in scaled} == {np.dtype(float)}
