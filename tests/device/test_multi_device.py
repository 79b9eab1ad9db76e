"""Work dealt to several devices: all of it done once, in order, whatever happens to one of them."""

import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.portions import fails_on_seven, first_dies, slow, squares
from threadpoolctl import threadpool_info, threadpool_limits

from clresample import Blend, DeviceError, deblend, deblend_many
from clresample.deblending import batch
from clresample.device import multi_device
from clresample.device.device_cache import DeviceWarning
from clresample.device.host import n_host_cores
from clresample.device.multi_device import (
    _DevicePool,
    _Portions,
    distribute,
    iterate_threads,
    map_threads,
    one_blas_thread,
    prefetch,
)
from clresample.device.workers.crew import Worker


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_linear_algebra_has_one_thread_until_the_last_caller_leaves():
    """Also where the first to come is the first to go, as in two threads; and after an error."""
    with threadpool_limits(2, user_api="blas"):
        first, last = one_blas_thread(), one_blas_thread()
        first.__enter__()
        last.__enter__()
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        last.__exit__(None, None, None)
        assert blas_threads() == {2}
        with pytest.raises(ArithmeticError), one_blas_thread():
            raise ArithmeticError
        assert blas_threads() == {2}


def test_fits_have_linear_algebra_on_one_thread(monkeypatch):
    """Of 32 scenes on two cores, two threads take 2.7 times the processor time."""
    seen = []

    def noted(*_, **__):
        seen.append(blas_threads())
        raise ValueError("no fit")

    monkeypatch.setattr(batch, "Fit", noted)
    with threadpool_limits(2, user_api="blas"):
        (failure,) = deblend_many([Blend([None], [None])])
        with pytest.raises(ValueError, match="no fit"):
            deblend([None], [None])
    assert seen == [{1}, {1}]
    assert "no fit" in failure.reason


def dealt(function, items, devices, most=1000):
    seen = []
    return distribute(function, items, devices, done=seen.append, most=most), seen


def test_everything_is_done_once_and_in_order(device):
    results, seen = dealt(squares, range(30), [device, device])
    assert [square for square, _ in results] == [n * n for n in range(30)]
    pids = {pid for _, pid in results}
    assert len(pids) == 2 and os.getpid() not in pids
    assert seen == sorted(seen) and seen[-1] == 30


def test_processes_of_one_device_share_its_threads():
    share = str(max(1, n_host_cores() // 2))
    assert _DevicePool([("cpu", 0)] * 2).environment["POCL_MAX_PTHREAD_COUNT"] == share
    assert "POCL_MAX_PTHREAD_COUNT" not in _DevicePool([("cpu", 0), ("gpu", 1)]).environment


def test_an_error_is_raised_by_name_when_nobody_is_left(device):
    with (
        pytest.warns(DeviceWarning, match=r"failed: ArithmeticError: seven; .* goes on"),
        pytest.raises(DeviceError, match=r"failed: ArithmeticError: seven; .*seven"),
    ):
        dealt(fails_on_seven, range(9), [device, device])


def test_what_a_dead_process_had_is_done_by_the_others(device, tmp_path):
    items = [(str(tmp_path), n) for n in range(12)]
    with pytest.warns(DeviceWarning, match="ended with exit status 3; .* goes on") as caught:
        results, _ = dealt(first_dies, items, [device, device])
    assert results == list(range(12)) and caught[0].filename == __file__


def test_equal_portions_do_not_depend_on_speed(device):
    done, most = [], 3
    run = {"done": done.append, "most": most, "equal": True, "imports_main": False}
    results = distribute(squares, range(8), [device, device], **run)
    assert [square for square, _ in results] == [n * n for n in range(8)]
    pids = [pid for _, pid in results]
    assert all(len(set(pids[i : i + most])) == 1 for i in range(0, 8, most))
    assert sorted(np.diff([0, *done])) == [2, 3, 3]


@pytest.mark.parametrize(
    "kind, cores, units, free_gb, expected",
    [("CPU", 8, 8, 64, 8), ("CPU", 8, 2, 64, 2), ("CPU", 2, 8, 64, 2), ("CPU", 8, 8, 5, 3)]
    + [("CPU", 8, 8, 0.1, 1), ("GPU", 8, 80, 64, 1)],
)
def test_processes_beside_each_other(kind, cores, units, free_gb, expected, monkeypatch):
    monkeypatch.setattr(multi_device, "kind_of", lambda device: kind)
    monkeypatch.setattr(multi_device, "is_simulated", lambda device: False)
    monkeypatch.setattr(multi_device, "n_host_cores", lambda: cores)
    monkeypatch.setattr(multi_device, "free_memory", lambda: int(free_gb * 2**30))
    assert multi_device.n_beside(SimpleNamespace(max_compute_units=units)) == expected


def test_without_items_or_devices(device):
    assert dealt(squares, [], [device]) == ([], [])
    with pytest.raises(ValueError, match="device is an empty list"):
        dealt(squares, [1], [])
    with pytest.raises(DeviceError, match="fits no device"):
        dealt(squares, [1], [device, "no such device"])


def test_ctrl_c_keeps_what_was_done(device):
    def stop(n_done):
        if n_done >= 4:
            raise KeyboardInterrupt

    results = distribute(slow, list(range(40)), [device], done=stop, most=4)
    assert results[:4] == [0, 1, 2, 3]
    assert results[8:] == [None] * 32


def portions(n_items, most, speeds):
    table = _Portions(range(n_items), most)
    table.speeds = speeds
    return table


def test_portions_follow_the_speeds():
    quick, slower, new = Worker(0), Worker(1), Worker(2)
    table = portions(200, 1000, {0: 90.0, 1: 10.0})
    assert len(table.take(quick, [quick, slower])) == 90
    assert len(table.take(slower, [quick, slower])) == 5
    assert len(table.take(new, [quick, slower, new])) == 4
    assert len(portions(200, 7, {0: 90.0, 1: 10.0}).take(quick, [quick, slower])) == 7
    last = portions(1, 7, {0: 90.0, 1: 10.0})
    assert last.take(slower, [quick, slower]) == [(0, 0)] and not last
    assert last.take(quick, [quick, slower]) == []


def test_portions_of_all_sizes_are_each_taken_once():
    table, workers = portions(50, 9, {0: 3.0, 1: 1.0}), [Worker(0), Worker(1)]
    taken = []
    while table:
        for worker in workers:
            taken += table.take(worker, workers)
    assert sorted(taken) == [(i, i) for i in range(50)]


def test_ahead_gives_the_items_in_order_and_at_most_two_beside_the_one_in_use():
    made, threads = [], set()

    def items():
        for i in range(6):
            threads.add(threading.current_thread())
            made.append(i)
            yield i

    used = []
    for i in prefetch(items()):
        used.append(i)
        assert len(made) <= len(used) + 2
    assert used == list(range(6)) and threading.current_thread() not in threads


def test_ahead_raises_what_was_raised_in_its_turn():
    def items():
        yield 1
        raise ValueError("two is missing")

    given = prefetch(items())
    assert next(given) == 1
    with pytest.raises(ValueError, match="two is missing"):
        next(given)


@pytest.mark.parametrize("n_threads", [1, 3])
def test_threads_give_what_each_item_gives_in_order(n_threads):
    """As many at a time as there may be; what one raises is raised."""
    going, most, all_in = [], [], threading.Barrier(n_threads, timeout=10)

    def square(i):
        going.append(i)
        most.append(len(going))
        all_in.wait()
        going.remove(i)
        return i * i

    found = map_threads(n_threads, square, range(2 * n_threads))
    assert found == [i * i for i in range(2 * n_threads)]
    assert max(most) == n_threads and map_threads(n_threads, square, []) == []
    with pytest.raises(ZeroDivisionError):
        map_threads(n_threads, lambda i: 1 / i, [1, 0, 2])


def test_items_that_no_thread_has_begun_are_left_out_once_nobody_asks():
    begun, gate = [], threading.Event()

    def wait(i):
        begun.append(i)
        gate.wait(0.05 * (i > 0))
        return i

    results = iterate_threads(2, wait, range(100))
    assert next(results) == 0
    results.close()
    assert len(begun) < 100


def test_the_host_has_as_many_threads_as_its_processor_may_use(monkeypatch):
    """Those of a CPU that is the device; beside another one all cores that the process may use."""
    cpu = SimpleNamespace(kind="CPU", compute_units=3)
    gpu = SimpleNamespace(kind="GPU", compute_units=100)
    monkeypatch.setattr(multi_device, "MAX_THREADS", 6)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(5)), raising=False)
    assert multi_device.host_threads(cpu) == 3 and multi_device.host_threads(gpu) == 5
    cpu.compute_units = 64
    assert multi_device.host_threads(cpu) == 5
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 9)
    assert multi_device.host_threads(cpu) == multi_device.host_threads(gpu) == 6


def test_ahead_ends_its_thread_when_it_is_closed():
    before = threading.active_count()
    endless = prefetch(iter(int, 1))
    assert next(endless) == 0 and threading.active_count() == before + 1
    endless.close()
    assert threading.active_count() == before
