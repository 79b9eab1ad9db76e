"""A run and a worker that are killed: `bench.soak` in small."""

import sys

import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_killed_runs_end_with_the_same_catalogue():
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    from bench.soak import soak

    rows = list(soak(2, 3))
    assert [row["what"] for row in rows] == ["run", "worker"]
    assert sum(row["kills"] for row in rows) >= 1  # a moment may come after the end
    assert all(row["same"] for row in rows)
