"""`bench.kills commands` in small: what it kills, and that it finds what is not whole."""

import json

import pytest

from bench.kills import commands as kills


def test_killed_runs_leave_all_or_nothing():
    pytest.importorskip("galsim")
    rows = list(kills.kills(1, 0, ["example"]))
    assert [(row["command"], row["over"]) for row in rows] == [
        ("example", False),
        ("example", True),
    ]
    assert all(row["good"] for row in rows), rows


HALF = """
import os, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("-o") + 1])
out.mkdir(exist_ok=True)
for name in "a", "b":
    with open(out / name, "w") as file:
        file.write(1000 * "new ")
"""


def test_what_is_cut_short_or_mixed_is_seen(tmp_path, monkeypatch):
    """Of a command that writes its files one by one in their place."""
    module = tmp_path / "clresample" / "cli"
    module.mkdir(parents=True)
    (module.parent / "__init__.py").write_text("")
    (module / "__init__.py").write_text("def main(words):\n" + _indented(HALF))
    (tmp_path / "bench").symlink_to(kills.ROOT / "bench")
    monkeypatch.setattr(kills, "ROOT", tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    way = kills.Way("plain", ["simulate", "-o", "OUT"], tmp_path, over=True)
    assert [line.split()[0] for line in way.moments] == ["os.mkdir", "open", "open"]
    short, mixed = way.killed(2, 100), way.killed(3, 0)
    assert short["left"] == mixed["left"] == "mixed"
    assert not short["good"] and short["about"]["mixed"] == ["a"]
    assert not mixed["good"] and mixed["about"]["mixed"] == []  # whole, but a new one and an old
    assert json.dumps(short)


def _indented(text):
    return "".join(f"    {line}\n" for line in text.splitlines())
