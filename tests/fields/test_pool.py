"""Worker processes: tasks that fail, hang or are killed cost themselves at most."""

import errno
import multiprocessing
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.checkout import ROOT
from helpers.tasks import (
    Shared,
    held_before,
    name_of_process,
    on_device,
    shared_there,
    take,
    whose,
    work,
)

from clresample import DeviceError, FieldOptions
from clresample.device.discovery import DeviceLostError
from clresample.device.workers.outcome import Cause
from clresample.device.workers.pool import WorkerPool
from clresample.fields.execution.backend import make_backend
from clresample.fields.execution.reason import reason_of
from clresample.fields.options import RunProgress
from clresample.files.atomic import FileError, WriteError


def ran(function, contexts, tasks, n_workers, again=None, **given):
    with WorkerPool(n_workers, **given) as pool:
        return list(pool.run(function, contexts, tasks, again))


def outcomes(folder, tasks, n_workers=2, **given):
    return {o.task: o for o in ran(work, [str(folder)], tasks, n_workers, **given)}


@pytest.mark.parametrize("n_workers", [0, 1, 2])
def test_values_and_errors_come_back(tmp_path, n_workers):
    found = outcomes(tmp_path, ["a", "raise", "b"], n_workers)
    assert [found[t].value for t in "ab"] == ["A", "B"]
    assert str(found["raise"].reason).startswith("ValueError: a bad blend")
    assert found["raise"].cause is Cause.TASK


def test_a_worker_that_is_killed_or_hangs_loses_its_own_task_alone(tmp_path):
    tasks, found = ["a", "die", "b", "hang", "c"], {}
    began = time.monotonic()
    with WorkerPool(2, limit_s=120.0) as pool:
        for outcome in pool.run(work, [str(tmp_path)], tasks):
            found[outcome.task] = outcome
            if len(found) == len(tasks) - 1:  # it hangs alone: no other has to end in time
                pool.limit_s = 1.0
    assert time.monotonic() - began < 120
    assert [found[t].value for t in "abc"] == ["A", "B", "C"]
    assert "signal 9" in str(found["die"].reason) and found["die"].cause is Cause.WORKER
    assert "over 1 s" in str(found["hang"].reason)


def test_again_replaces_a_failed_task(tmp_path):
    def again(outcome):
        if outcome.task == "die once":
            return ["die once"]
        return ["a", "b"] if outcome.task == "raise" else None

    found = outcomes(tmp_path, ["die once", "raise", "die"], 1, again=again)
    assert set(found) == {"die once", "a", "b", "die"}
    assert found["die once"].value == "DIE ONCE"
    assert found["die"].value is None


def test_all_workers_begin_before_they_are_asked(tmp_path):
    with WorkerPool(2) as pool:
        pool.begin(whose)
        begun = {child.pid for child in multiprocessing.active_children()}
        found = [o.value for o in pool.run(whose, [str(tmp_path)], ["a"])]
        assert len(begun) == 2 and found[0] in begun
        pool.begin(whose)  # those that are there stay
        assert begun == {child.pid for child in multiprocessing.active_children()}


def test_idle_workers_end_without_a_signal(tmp_path):
    """It could arrive while they end, and be reported as an error."""
    with WorkerPool(2) as pool:
        assert len(list(pool.run(whose, [str(tmp_path)], range(4)))) == 4
        processes = [worker.process for worker in pool.workers]
    assert [process.exitcode for process in processes] == [0, 0]


def test_a_worker_that_dies_before_it_is_asked_is_replaced(tmp_path):
    with WorkerPool(1) as pool:
        pool.begin(whose)
        (first,) = multiprocessing.active_children()
        first.kill()
        first.join()
        (outcome,) = pool.run(whose, [str(tmp_path)], ["a"])
        assert outcome.reason is None and outcome.value != first.pid


def test_a_device_that_is_gone_leaves_its_tasks_to_the_others():
    found = ran(on_device, ["good", "gone"], range(6), 2)
    assert sorted(o.task for o in found) == list(range(6))
    assert all(o.value == "good" and o.reason is None for o in found)
    with pytest.raises(DeviceError, match="gone no longer answers"):
        ran(on_device, ["gone", "gone"], range(2), 2)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the system holds no memory")
def test_the_system_holds_a_worker_to_its_memory():
    found = ran(take, [0], [10, 4000], 1, bound=1 << 30)
    small, large = sorted(found, key=lambda o: o.task)
    assert small.value == 10 << 20
    assert large.reason.kind == "MemoryError" and large.cause is Cause.TASK


def test_a_stage_leaves_nothing_of_the_one_before():
    with WorkerPool(1) as pool:
        for _ in range(2):  # the second one's first task still meets the first one's context
            found = [o.value for o in pool.run(shared_there, [Shared()], range(3))]
            assert found[1:] == [1, 1]
        (outcome,) = pool.run(whose, ["."], [0])
        found = [o.value for o in pool.run(shared_there, ["."], range(2))]
        assert outcome.reason is None and found == [0, 0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("n_workers", [0, 1])
def test_what_a_task_leaves_behind_is_freed_before_the_next(n_workers):
    large = 64 << 20
    found = ran(held_before, [large], [0, 1, "raises", 2, 3], n_workers)
    held = [o.value for o in found if o.reason is None]
    assert len(held) == 4 and max(held) - held[0] < large


def test_workers_live_on_from_one_run_to_the_next():
    with WorkerPool(2) as pool:
        first = {o.value for o in pool.run(name_of_process, [None], range(8))}
        second = {o.value for o in pool.run(name_of_process, ["other"], range(8))}
    assert {pid for pid, _ in second} <= {pid for pid, _ in first}
    assert {context for _, context in second} == {"other"}


PARENT = """
import os, sys
sys.path[:0] = {paths!r}
from clresample.device.workers.pool import WorkerPool
from helpers.tasks import say_and_sleep
if __name__ == "__main__":
    with WorkerPool(1) as pool:
        list(pool.run(say_and_sleep, [{folder!r}], ["task"]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="no prctl")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(paths=[str(ROOT), str(ROOT / "tests")], folder=str(tmp_path)))
    parent = subprocess.Popen([sys.executable, str(script)], cwd=ROOT)
    try:
        end = time.monotonic() + 120
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
            assert parent.poll() is None and time.monotonic() < end
            time.sleep(0.05)
        pid = int((tmp_path / "pid").read_text())
    finally:
        parent.kill()
        parent.wait()
    end = time.monotonic() + 30
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_cluster_without_dask_is_refused_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match="pip install distributed"):
        make_backend(FieldOptions(scheduler="tcp://127.0.0.1:8786"), RunProgress())


def test_each_device_has_a_worker_at_least():
    engine = make_backend(FieldOptions(device=["a", "b"], workers=3), RunProgress())
    assert engine.n_workers == 3 and engine.device_shares == [("a", 2), ("b", 2)]
    assert make_backend(FieldOptions(device=["a", "b"]), RunProgress()).n_workers == 2
    assert make_backend(FieldOptions(device="a"), RunProgress()).n_workers == 0


@pytest.mark.parametrize(
    "error, cause",
    [
        (ValueError("cannot be written"), Cause.TASK),
        (FileError("gone.fits: cannot be read"), Cause.TASK),
        (WriteError("part.fits: cannot be written"), Cause.DISK),
        (OSError(errno.ENOSPC, "No space left on device"), Cause.DISK),
        (OSError(errno.EACCES, "denied"), Cause.TASK),
        (DeviceLostError("gone no longer answers"), Cause.DEVICE),
        (ModuleNotFoundError("no sep"), Cause.PACKAGE),
    ],
)
def test_an_error_has_a_cause_whatever_its_words(error, cause):
    with pytest.raises(type(error)) as raised:
        raise error
    found = reason_of(raised.value)
    assert found.cause is cause and str(found).startswith(f"{type(error).__name__}: ")
    is_for_users = isinstance(error, (ValueError, DeviceLostError))
    assert (", line " in found.message) is not is_for_users


def test_an_error_of_a_library_has_its_place():
    with pytest.raises(ValueError) as raised:
        int("a")
    assert ", line " in reason_of(raised.value).message
