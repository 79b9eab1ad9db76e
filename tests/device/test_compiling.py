"""Builds from source are announced once to whoever looks, those from a cache never."""

import sys
import time

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
    assert [notice.build(compile_slowly) for _ in range(2)] == ["program"] * 2
    assert capsys.readouterr().err == "compiling kernels for EPYC, once\n" * is_terminal
