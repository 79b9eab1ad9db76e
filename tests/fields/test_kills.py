"""Runs that are killed, starved and damaged: `bench.kills fields` in small.

Workers that hang are in test_pool.py and test_cluster.py, damaged tiles of images in test_run.py.
"""

import sys

import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_disturbed_runs_end_with_the_same_catalogue(monkeypatch):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    from bench.kills import fields

    monkeypatch.setattr(fields, "WRITES", 1)
    monkeypatch.setattr(fields, "WORKERS", 1)  # a process that begins takes a core-second
    monkeypatch.setattr(fields, "SIZE", 128)  # [px]
    monkeypatch.setattr(fields, "TALL", 320)  # [px]
    rows = list(fields.soak(1, 3, ("disk", "write")))
    assert [row["what"] for row in rows] == ["worker", "disk", "write"]
    # at a moment that is chosen before, which may come after the end
    assert sum(row["kills"] for row in rows if row["what"] in ("worker", "write")) >= 1
    assert all(row["good"] for row in rows), rows
