"""The loop under all workers: faults of devices are counted, tasks are repeated or replaced."""

import pytest

from clresample import DeviceError
from clresample.device.workers.crew import Crew, TaskQueue, Worker
from clresample.device.workers.outcome import Cause, Reason

FAULT, ERROR, DEATH = Cause.DEVICE, Cause.TASK, Cause.WORKER


class Scripted(Crew):
    """Workers whose tasks end one by one as a list of causes says; None is a success."""

    def __init__(self, n_workers, causes):
        self.workers, self.causes = [Worker(i) for i in range(n_workers)], iter(causes)
        self.sent, self.renewed, self.dropped = [], [], []

    def ready(self, n_tasks):
        return [worker for worker in self.workers if worker.task is None][:n_tasks]

    def send(self, worker, job):
        self.sent.append((worker.number, worker.task))

    def ended(self, job):
        worker, cause = self.busy[0], next(self.causes)
        return [(worker, worker.outcome(reason=cause and Reason("why", cause)))]

    def renew(self, worker):
        self.renewed.append(worker.number)

    def drop(self, worker, reason):
        self.workers.remove(worker)
        self.dropped.append(worker.number)


@pytest.mark.parametrize(
    "causes, dropped, tasks",
    [
        ([FAULT, None, FAULT, None], [], "aabb"),  # a success in between: counted from 0
        ([FAULT, ERROR, FAULT, None], [], "aabb"),
        ([FAULT, DEATH, FAULT, None], [0], "abacc"),  # a death says nothing of the device
    ],
)
def test_a_device_is_lost_by_its_second_fault_in_a_row(causes, dropped, tasks):
    crew = Scripted(1 + len(dropped), [*causes, None, None])
    names = "abc" if dropped else "ab"
    found = list(crew.outcomes(None, TaskQueue(names)))
    assert crew.dropped == dropped and crew.renewed == [0] * causes.count(FAULT)
    assert sorted(o.task for o in found) == sorted(names)
    assert "".join(task for _, task in crew.sent) == tasks


def test_without_workers_it_ends_and_failed_tasks_may_be_replaced():
    with pytest.raises(DeviceError, match="why"):
        list(Scripted(1, [FAULT, FAULT]).outcomes(None, TaskQueue("a")))
    more = {"a": ["b", "c"]}
    crew = Scripted(1, [ERROR, None, ERROR, None])
    found = list(crew.outcomes(None, TaskQueue("ad"), lambda outcome: more.get(outcome.task)))
    assert [o.task for o in found] == ["b", "c", "d"]
    assert [o.cause for o in found] == [None, ERROR, None]
