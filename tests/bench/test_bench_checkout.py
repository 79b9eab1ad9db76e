"""Two checkouts compared by turns: a command measures the one it is run from, and says so."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from helpers.checkout import ROOT

VERSION = "0.0.0+copy"


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of this checkout that calls itself by another version."""
    folder = tmp_path_factory.mktemp("copy")
    for name in ("clresample", "kernels", "bench"):
        ignored = shutil.ignore_patterns("__pycache__", "report")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    face = folder / "clresample" / "__init__.py"
    text = face.read_text()
    before, line, after = text.partition('\n__version__ = "')
    assert line
    face.write_text(f"{before}{line}{VERSION}{after[after.index(chr(34)) :]}")
    return folder


def test_a_command_measures_the_checkout_it_is_run_from(checkout, tmp_path):
    """Itself and by worker processes."""
    pytest.importorskip("galsim")
    options = ("--only", "single", "--modes", "one", "--scenes", "1", "--n", "1", "--re", "2")
    options += ("--snr", "100", "--processes", "2")
    file = tmp_path / "found.json"
    result = subprocess.run(
        [sys.executable, "-m", "bench.ladder", *options, "--json", str(file)],
        cwd=checkout,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(file.read_text())
    assert found["record"]["clresample"] == VERSION
    assert found["rows"]
