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


@pytest.mark.parametrize(
    ("module", "options"),
    [
        (
            "render",
            ("--sizes", "20", "--pairs", "EUCLID-RUBIN", "--galaxies", "1", "--seconds", "0.01"),
        ),
        (  # by worker processes
            "ladder",
            ("--only", "single", "--modes", "one", "--scenes", "1", "--n", "1", "--re", "2")
            + ("--snr", "100", "--processes", "2"),
        ),
    ],
)
def test_a_command_measures_the_checkout_it_is_run_from(checkout, tmp_path, module, options):
    pytest.importorskip("galsim")
    file = tmp_path / "found.json"
    result = subprocess.run(
        [sys.executable, "-m", f"bench.{module}", *options, "--json", str(file)],
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
