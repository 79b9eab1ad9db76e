"""Fields on the workers of a dask.distributed cluster: the same bytes, whatever dies."""

import pytest
from helpers.fields import mosaics_of
from helpers.tasks import Folder, act, nothing, path_of

from clresample import FieldOptions
from clresample.device.workers.outcome import Cause
from clresample.fields.execution.cluster import DaskCluster
from clresample.fields.execution.tasks import TaskKind
from clresample.fields.options import RunProgress
from clresample.fields.run import run_field
from clresample.fields.strips import MAX_BYTES, STRIPS

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler():
    """Two worker processes with a nanny each."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", memory_limit="3GiB"
    ) as cluster:
        yield cluster.scheduler_address


class _Said(RunProgress):
    def __init__(self):
        self.lines = []

    def dashboard(self, address):
        self.lines.append(address)


def test_a_cluster_ends_with_the_bytes_of_one_process(done, sky, scheduler, tmp_path):
    folder, _ = done
    said = _Said()
    options = FieldOptions(scheduler=scheduler)
    run = run_field(mosaics_of(sky), tmp_path, options=options, progress=said)
    assert len(said.lines) == 1 and said.lines[0].startswith("http")
    assert len({outcome.worker for stage, outcome in run.task_times if stage == "fit"}) == 2
    for name in ("catalogue.fits", "models.fits", "residual_Euclid.fits"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


def test_workers_that_die_or_hang_cost_their_own_tasks_alone(scheduler, tmp_path):
    cluster = DaskCluster(scheduler, (), 120.0, RunProgress())
    tasks = ["a", "die", "b", "raise", "hang", "c", "d"]
    try:
        work, context = TaskKind(nothing, act, path_of), Folder(str(tmp_path))
        found = {}
        for outcome in cluster.run(work, context, tasks):
            found[outcome.task] = outcome
            if len(found) == len(tasks) - 1:  # it hangs alone: no other has to end in time
                cluster.crew.limit_s = 3.0
    finally:
        cluster.close()
    assert [found[t].value for t in "abcd"] == list("ABCD")
    assert all((tmp_path / f"{t}.txt").read_text() == t for t in "abcd")
    assert found["die"].cause is found["hang"].cause is Cause.WORKER
    assert "over 3 s" in str(found["hang"].reason)
    assert str(found["raise"].reason).startswith("ValueError: a bad blend")


def rows_kept(context, task, given):
    """Memory [bytes] that decoded rows may take on a worker."""
    return STRIPS.most, b""


def test_decoded_rows_are_held_to_a_part_of_a_workers_memory(scheduler, tmp_path):
    cluster = DaskCluster(scheduler, (), 60.0, RunProgress())
    try:
        (found,) = cluster.run(TaskKind(nothing, rows_kept, path_of), Folder(str(tmp_path)), ["a"])
    finally:
        cluster.close()
    assert found.value == int(0.1 * 3 * (1 << 30)) < MAX_BYTES


def test_what_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr("clresample.fields.execution.cluster.CONNECT_S", 0.5)  # [s]
    with pytest.raises(ValueError, match="scheduler 'tcp://127.0.0.1:1' does not answer"):
        DaskCluster("tcp://127.0.0.1:1", (), None, RunProgress())
