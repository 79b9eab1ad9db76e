"""The benchmark beside other deblenders: its table, and its answer without BlendingToolKit."""

import importlib.util
import json

import pytest
from helpers.checkout import run_python

HAS_BTK = importlib.util.find_spec("btk") is not None


@pytest.mark.skipif(HAS_BTK, reason="BlendingToolKit is installed")
def test_without_blending_toolkit_the_extra_is_named():
    with pytest.raises(ImportError, match=r"pip install 'clresample\[peers\]'"):
        importlib.import_module("bench.peers")


@pytest.mark.skipif(not HAS_BTK, reason="BlendingToolKit is not installed")
def test_a_row_for_each_deblender(tmp_path):
    options = "--blends", "1", "--json", str(tmp_path / "rows.json")
    result = run_python("-m", "bench.peers", *options)
    assert not result.returncode, result.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    names = [row["deblender"] for row in rows]
    assert names[0] == "SEP" and names[-1] == "clresample"
    assert all(0 < row["ssim"] <= 1 for row in rows)
