"""Progress for people and for logs."""

import logging
import sys

import pytest

from clresample.drawing import bar as bar_module
from clresample.drawing.bar import ProgressBar


def test_a_log_gets_a_line_now_and_then_and_one_at_the_end(capsys, monkeypatch):
    monkeypatch.setattr(bar_module, "LINE_S", 10.0)
    clock = iter([0.0, 4.0, 11.0, 12.0, 13.0])
    monkeypatch.setattr(bar_module.time, "monotonic", lambda: next(clock))
    with ProgressBar(4, "blends") as bar:
        for n in (1, 2, 3, 4):
            bar(n)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["2 of 4 blends after 11 s", "4 of 4 blends after 13 s"]


@pytest.mark.parametrize("level, shown", [(logging.INFO, True), (logging.WARNING, False)])
def test_lines_go_through_logging_where_it_is_set_up(capsys, caplog, level, shown):
    with caplog.at_level(level, logger="clresample"), ProgressBar(4, "blends") as bar:
        bar(4)
    assert bool(caplog.records) == shown and not capsys.readouterr().err
    assert not shown or caplog.messages[0].startswith("4 of 4 blends after")


def test_a_terminal_gets_a_bar(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with ProgressBar(4, "blends") as bar:
        bar(4)
    assert "4/4" in capsys.readouterr().err
