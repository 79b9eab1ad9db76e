"""The benchmarks' common code: files whole or absent, logs that a later run continues."""

import json
import math

import pytest


def test_json_is_written_whole_or_not_at_all(tmp_path):
    from bench.harness.records import read_json, write_json

    file = tmp_path / "x.json"
    write_json(file, {"rows": [1.0, float("inf"), {"a": float("nan")}]})
    assert json.loads(file.read_text()) == {"rows": [1.0, None, {"a": None}]}
    first, second, third = read_json(file)["rows"]
    assert first == 1.0
    assert math.isnan(second)
    assert math.isnan(third["a"])
    with pytest.raises(TypeError):
        write_json(file, {"rows": object()})
    assert json.loads(file.read_text())["rows"][0] == 1.0
    assert list(tmp_path.iterdir()) == [file]


def test_a_log_goes_on_after_an_interruption(tmp_path):
    from bench.harness.options import BadOption
    from bench.harness.records import Log

    path = tmp_path / "run.jsonl"
    log = Log(path, {"device": "A"})
    log.append(("x", 1), [1.0, float("nan")])
    log.append(("x", 2), {"ms": 3})
    with path.open("ab") as file:
        file.write(b'[["x", 3], [1.')  # the power went
    log = Log(path, {"device": "A"})
    assert log.done == {("x", 1): [1.0, None], ("x", 2): {"ms": 3}}
    log.append(("x", 3), 4)
    assert Log(path, {"device": "A"}).done["x", 3] == 4
    with pytest.raises(BadOption, match="device A, not B"):
        Log(path, {"device": "B"})
