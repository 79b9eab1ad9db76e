"""Progress of `clresample field`: on a terminal, in a log, and none if quiet."""

import io
import re
from types import SimpleNamespace

import pytest
from helpers.checkout import run_python

from clresample import simulate_field
from clresample.cli.fields.progress import LINE_S, ProgressDisplay, duration
from clresample.cli.simulate import write_field


class Clock:
    """Seconds that a test moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def live(monkeypatch):
    """A function that makes a ProgressDisplay on a stream: (live, clock, stream)."""

    def make(stream, quiet=False):
        monkeypatch.setattr("sys.stderr", stream)
        clock = Clock()
        return ProgressDisplay(SimpleNamespace(command="field", quiet=quiet), clock), clock, stream

    return make


def test_a_terminal_shows_blends_sources_a_second_and_the_time_left(live):
    shown, clock, stream = live(Terminal())
    shown.stage("fit", 40)
    shown.step(8)  # of a run before: no speed of this one
    assert shown.speed() == ""
    clock.now += 4
    shown.step(8, 20)
    shown.bar.refresh()
    text = stream.getvalue()
    assert "16 of 40 blends" in text and "5.0 sources/s" in text
    assert "about 12 s left" in text  # 24 blends at 2 a second
    shown.time_left(47)
    clock.now += 5
    assert shown.speed() == "2.2 sources/s, about 42 s left in this stage"
    shown.stage("pieces", 4)
    shown.time_left(3)
    assert "about 3 s left" in stream.getvalue() and shown.speed() == "about 3 s left in this stage"
    clock.now += 4
    assert shown.speed() == "about 0 s left in this stage"
    shown.message("3 blends are set aside")
    shown.dashboard("http://127.0.0.1:8787\x1b[2J")
    lines = stream.getvalue().replace("\r", "\n").splitlines()
    assert "clresample field: 3 blends are set aside" in lines
    assert "clresample field: dashboard: http://127.0.0.1:8787\\x1b[2J" in lines
    shown.close()


def test_a_log_gets_a_line_now_and_then(live):
    shown, clock, stream = live(io.StringIO())
    shown.stage("search", 4)
    shown.step(1, 7)
    assert stream.getvalue() == ""
    clock.now += LINE_S + 1
    shown.step(1, 24)
    line = f"search: 2 of 4 tiles, {31 / (LINE_S + 1):.1f} sources/s, about 31 s left in this stage"
    assert stream.getvalue() == f"clresample field: {line}\n"
    shown.step(1, 5)
    assert stream.getvalue().count("\n") == 1
    shown.close()


def test_quiet_runs_show_nothing(live):
    shown, clock, stream = live(Terminal(), quiet=True)
    shown.stage("fit", 4)
    clock.now += 100
    shown.step(2, 7)
    shown.message("a note")
    shown.close()
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "words"), [(41.7, "42 s"), (200, "3 min"), (7800, "2 h 10 min")]
)
def test_times_are_told_in_words(seconds, words):
    assert duration(seconds) == words


def test_a_field_prints_what_its_kernels_took(tmp_path):
    """Of both worker processes together, once; of this one alone: test_kernel_profiler.py."""
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    sky = simulate_field(3, n_pixels=96, density=90, rubin_bands=("i",))
    toml, *_ = write_field(tmp_path / "sky", sky)
    words = [toml, "-o", tmp_path / "out", "--quiet", "--workers", 2, "--profile"]
    answer = run_python("-m", "clresample.cli", "field", *map(str, words))
    assert answer.returncode == 0, answer.stderr
    assert answer.stderr.count("kernels on ") == 1
    assert re.search(r"\btake_step +\d", answer.stderr), answer.stderr
