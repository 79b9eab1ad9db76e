"""Builds from source are announced once to whoever looks, those from a cache never."""

import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.checkout import ROOT

from clresample.device.build_lock import build_lock
from clresample.device.compiling import MAX_CACHED_S, CompilationNotice
from clresample.device.device import Device


def compile_slowly():
    end = time.thread_time() + 1.5 * MAX_CACHED_S
    while time.thread_time() < end:
        pass
    return "program"


@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_build_from_source_is_announced_once_in_a_terminal(monkeypatch, capsys, is_terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    notice = CompilationNotice("EPYC")
    assert notice.build(lambda: "cached") == "cached"
    assert capsys.readouterr().err == ""
    assert [notice.build(compile_slowly) for _ in range(3)] == ["program"] * 3
    lines = capsys.readouterr().err
    assert lines.count("compiling kernels for EPYC, once\n") == is_terminal
    counts = ["EPYC: 1 programs" in lines, "EPYC: 2 programs" in lines]
    assert counts == [is_terminal] * 2 and (lines.endswith("\r") or not lines)


def test_the_first_launch_of_a_kernel_is_locked_as_its_build_is(device, kernels, monkeypatch):
    """Drivers for CPUs compile there; later launches exclude nobody."""
    locked = []

    @contextmanager
    def lock(program):
        locked.append(program)
        yield

    monkeypatch.setattr("clresample.device.program.build_lock", lock)
    device = Device(device.cl)  # which has built nothing
    launch = device.launcher("mixed.cl", "mixed", local_size=(1,))
    assert len(locked) == 1 and "mixed.cl" in locked[0] and device.name in locked[0]
    x, out = device.zeros(30, np.float32), device.zeros(12, np.float32)
    launch.bind(x=x, out=out, n=10, first=1, factor=3.0, add=7, step=2)
    for _ in range(2):
        launch((12,))
    assert locked == locked[:1] * (1 + (device.kind == "CPU"))


LOCKED = """
import time
from clresample.device.build_lock import build_lock
with build_lock("a program"):
    print("compiling", flush=True)
    time.sleep(0.3)
    print("done", time.time())
"""


def locked_elsewhere():
    """A process that holds the lock of a program for 0.3 s."""
    words = [sys.executable, "-c", LOCKED]
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_processes_that_need_the_same_program_wait_for_each_other(tmp_path, monkeypatch):
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path))
    with locked_elsewhere() as other:
        assert other.stdout.readline() == "compiling\n"
        with build_lock("another program"):
            others_free = time.time()
        with build_lock("a program"):
            mine = time.time()
        done = float(other.stdout.readline().split()[1])
    assert others_free < done <= mine


def test_a_lock_is_given_up_after_a_while_and_where_it_cannot_be_had(tmp_path, monkeypatch):
    monkeypatch.setattr("clresample.device.build_lock.MAX_WAIT_S", 0.05)
    for folder in (tmp_path, "/proc/nobody"):
        monkeypatch.setenv("CLRESAMPLE_CACHE", str(folder))
        with locked_elsewhere() as other:
            assert other.stdout.readline() == "compiling\n"
            began = time.monotonic()
            with build_lock("a program"):
                assert time.monotonic() - began < 0.2
