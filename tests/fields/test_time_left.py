"""Predicted ends of a field's stages: arithmetic, without a run."""

import numpy as np
import pytest

from clresample.fields.execution.time_left import (
    FILE,
    REMEMBERED,
    TimeLeft,
    remember_pace,
    remembered_pace,
)


def run(costs, seconds, n_workers, began=100.0):
    """Deals tasks to workers as they become free: (end, task, worker, start), by their ends."""
    free, ends = dict.fromkeys(range(n_workers), began), []
    for task, took in enumerate(seconds):
        worker = min(free, key=free.get)
        ends.append((free[worker] + took, task, worker, free[worker]))
        free[worker] += took
    return sorted(ends)


@pytest.mark.parametrize("n_workers", [1, 2, 5])
def test_tasks_that_take_as_predicted_end_when_predicted(n_workers):
    costs = dict(enumerate([9.0, 7.0, 7.0, 5.0, 4.0, 2.0, 1.0, 1.0, 6.0]))
    ends = run(costs, [0.5 * cost for cost in costs.values()], n_workers)
    predicted = TimeLeft(costs, n_workers, 100.0)
    assert predicted.left(101.0) is None
    for end, task, worker, start in ends:
        predicted.end(task, worker, start, end)
        if predicted.n_workers <= len(predicted._free):
            assert predicted.left(end) == pytest.approx(ends[-1][0] - end)
    assert predicted.left(end) == 0 and predicted.pace == pytest.approx(0.5)


@pytest.mark.parametrize("pace", [2.7, 3.3])
@pytest.mark.parametrize("seed", range(3))
def test_the_time_left_is_right_to_a_fifth_from_the_first_tenth_on(seed, pace):
    """Each task takes up to 1.4 times as long as predicted, or as short; the pace is 10 % off."""
    rng = np.random.default_rng(seed)
    costs = dict(enumerate(np.sort(rng.lognormal(0, 1, 150))[::-1].tolist()))
    seconds = [3 * cost * 2 ** rng.uniform(-0.5, 0.5) for cost in costs.values()]
    ends = run(costs, seconds, 4)
    total, predicted = ends[-1][0] - 100, TimeLeft(costs, 4, 100.0, pace)
    for end, task, worker, start in ends:
        predicted.end(task, worker, start, end)
        if end - 100 > total / 10:
            assert end - 100 + predicted.left(end) == pytest.approx(total, rel=0.2)


def test_a_late_long_task_counts_in_full_and_an_overdue_one_goes_on():
    predicted = TimeLeft({"a": 1, "b": 1, "long": 10}, 2, 0.0)
    predicted.end("a", 0, 0.0, 2.0)
    predicted.end("b", 1, 0.0, 2.0)
    assert predicted.left(2.0) == pytest.approx(20)
    assert predicted.left(42.0) == pytest.approx(10)  # half of 20 s
    predicted.split("long", {"one half": 5, "other half": 5})  # tried again
    predicted.end("one half", 0, 30.0, 40.0)
    predicted.end("other half", 0, 40.0, 50.0)
    assert predicted.pace == 2 and predicted.left(50.0) == 0


def test_an_earlier_run_gives_a_pace_from_the_start():
    predicted = TimeLeft({"a": 1, "b": 9}, 1, 0.0, pace=2.0)
    assert predicted.left(0.0) == pytest.approx(20) and predicted.pace is None
    predicted.end("a", 0, 0.0, 6.0)
    pace = (6 + 2 * REMEMBERED * 10) / (1 + REMEMBERED * 10)
    assert predicted.left(6.0) == pytest.approx(9 * pace) and predicted.pace == 6


def test_paces_are_remembered_by_kind_of_run(tmp_path, monkeypatch):
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path / "new"))
    assert remembered_pace("EPYC, 2") is None
    remember_pace("EPYC, 2", 0.25)
    remember_pace("EPYC, 4", 0.5)
    assert (remembered_pace("EPYC, 2"), remembered_pace("EPYC, 4")) == (0.25, 0.5)
    for damaged in ("[1]", "{", '{"EPYC, 2": -1.0}', '{"EPYC, 2": "fast"}'):
        (tmp_path / "new" / FILE).write_text(damaged)
        assert remembered_pace("EPYC, 2") is None
    remember_pace("EPYC, 2", 0.125)
    assert remembered_pace("EPYC, 2") == 0.125
    monkeypatch.setenv("CLRESAMPLE_CACHE", "/proc/nobody")
    remember_pace("EPYC, 2", 0.25)
    assert remembered_pace("EPYC, 2") is None
