"""Launches repeated from a record read the present values, and nothing else is recorded."""

import threading

import numpy as np
import pytest

from clresample import DeviceError
from clresample.device.program import LaunchList, queue_anew


class Lost(Exception):
    """Of a driver that has lost its device."""

    code = -6


class Timed:
    """A profiler that keeps nothing."""

    @staticmethod
    def record(*launch):
        pass


@pytest.fixture
def doubled(device, kernels):
    """A function that queues out = 2 x of four numbers, and both arrays."""
    launch = device.launcher("scale.cl", "scale")
    x, out = device.put(np.arange(4, dtype=np.float32)), device.zeros(4, np.float32)
    return lambda: launch((4,), x=x, out=out), x, out


def test_repeated_launches_read_what_is_there_now(device, doubled, monkeypatch):
    """The function is called once, and again after `forget`."""
    queue, x, out = doubled
    calls = []
    launches = LaunchList(device, lambda: calls.append(queue()))
    for i in range(3):
        device.upload(np.full(4, i, np.float32), x)
        launches()
        assert (device.get(out) == 2 * i).all()
    assert len(calls) == 1
    launches.forget()
    launches()
    assert len(calls) == 2
    monkeypatch.setattr(device, "profile", Timed)  # profiled launches go through their Launchers
    for n in (3, 4):
        launches()
        assert len(calls) == n


def test_a_list_within_another_is_recorded_by_that(device, doubled):
    queue, x, out = doubled
    inner = LaunchList(device, queue)
    inner()
    back = device.launcher("scale.cl", "scale", OFFSET=1)

    def function():
        inner()
        back((4,), x=out, out=out)

    outer = LaunchList(device, function)
    for i in range(2):
        device.upload(np.full(4, i, np.float32), x)
        outer()
        assert (device.get(out) == 4 * i + 1).all()


def test_functions_to_be_called_anew_keep_their_place(device, kernels, doubled):
    """Between the launches before and after them, with their own launches, once each time."""
    queue, x, out = doubled
    back, calls = device.launcher("scale.cl", "scale", OFFSET=1), []

    def anew(i):
        calls.append(i)
        back((4,), x=out, out=x)

    def function():
        queue()
        queue_anew(anew, 5)
        queue()

    launches = LaunchList(device, function)
    for n in (1, 2):
        device.upload(np.ones(4, np.float32), x)
        launches()
        assert calls == [5] * n
        assert (device.get(out) == 10).all()  # 2 (2 (2 * 1) + 1)


def test_nothing_else_is_recorded(device, doubled):
    """Neither other threads' launches nor those of a function that raises."""
    queue, x, out = doubled
    other = threading.Thread(target=queue)

    def beside():
        other.start()
        other.join()

    launches = LaunchList(device, beside)
    launches()
    device.upload(np.zeros(4, np.float32), out)
    launches()
    assert not device.get(out).any()

    def function():
        queue()
        raise KeyboardInterrupt

    launches, calls = LaunchList(device, function), []
    with pytest.raises(KeyboardInterrupt):
        launches()
    queue()
    launches._function = lambda: calls.append(0)
    launches()
    assert calls == [0]
    device.upload(np.zeros(4, np.float32), out)
    launches()
    assert not device.get(out).any()


def test_a_repeated_launch_that_fails_is_a_device_error(device, doubled, monkeypatch):
    queue, *_ = doubled
    launches = LaunchList(device, queue)
    launches()

    def lost(*_):
        raise Lost

    monkeypatch.setattr(device, "_enqueue", lost)
    monkeypatch.setattr(device, "_error", Lost)
    with pytest.raises(DeviceError):
        launches()
