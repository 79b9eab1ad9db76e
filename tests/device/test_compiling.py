"""Builds from source are announced once to whoever looks, those from a cache never."""

import sys
import time
from types import SimpleNamespace

import pytest

from clresample.device.compiling import MAX_CACHED_S, CompilationNotice


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


@pytest.mark.parametrize("is_cold", [False, True])
def test_first_launches_are_waited_for_where_kernels_are_compiled(monkeypatch, is_cold):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    notice, kernel, waits = CompilationNotice("EPYC"), SimpleNamespace(int_ptr=7), []
    notice.build(compile_slowly if is_cold else lambda: "cached")
    for _ in range(2):
        notice.wait_for_first_launch(kernel, lambda: waits.append(1))
    assert len(waits) == is_cold
