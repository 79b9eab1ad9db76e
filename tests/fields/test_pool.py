"""Worker processes: tasks that fail, hang or are killed cost themselves at most."""

import os
import signal
import time
from pathlib import Path

import pytest

from clresample.fields.work.pool import run_tasks


def work(folder, task):
    """Tasks as words: what a worker may do."""
    Path(folder, f"{task}-{time.monotonic_ns()}").touch()
    if task == "raise":
        raise ValueError("a bad blend")
    if task == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "die once" and len(list(Path(folder).glob("die once-*"))) < 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "hang":
        time.sleep(600)
    return task.upper()


def outcomes(folder, tasks, n_workers=2, **given):
    return {o.task: o for o in run_tasks(work, str(folder), tasks, n_workers, **given)}


@pytest.mark.parametrize("n_workers", [0, 1, 2])
def test_values_and_errors_come_back(tmp_path, n_workers):
    found = outcomes(tmp_path, ["a", "raise", "b"], n_workers)
    assert [found[t].value for t in "ab"] == ["A", "B"]
    assert found["raise"].reason.startswith("ValueError: a bad blend")
    assert not found["raise"].worker_died


def test_a_worker_that_is_killed_or_hangs_loses_its_own_task_alone(tmp_path):
    tasks = ["a", "die", "b", "hang", "c"]
    began = time.monotonic()
    found = outcomes(tmp_path, tasks, limit_s=3.0)
    assert time.monotonic() - began < 60
    assert [found[t].value for t in "abc"] == ["A", "B", "C"]
    assert "signal 9" in found["die"].reason and found["die"].worker_died
    assert "over 3 s" in found["hang"].reason


def test_again_replaces_a_failed_task(tmp_path):
    def again(outcome):
        if outcome.task == "die once":
            return ["die once"]
        return ["a", "b"] if outcome.task == "raise" else None

    found = outcomes(tmp_path, ["die once", "raise", "die"], 1, again=again)
    assert set(found) == {"die once", "a", "b", "die"}
    assert found["die once"].value == "DIE ONCE"
    assert found["die"].value is None
