"""Start of a command: the modules that it imports, listed after it ran."""

import pytest
from helpers.checkout import run_python

from clresample.cli import main

# Each takes a tenth of a second or more, some half a second.
SLOW = {"numpy", "scipy", "astropy", "pyopencl", "matplotlib", "PIL", "galsim", "sep", "tqdm"}
# Parts of these that a fit with a catalogue has no use for.
UNUSED = {
    "scipy.signal",
    "scipy.stats",
    "scipy.interpolate",
    "scipy.integrate",
    "matplotlib.pyplot",
    "galsim",
    "sep",
}
RUN = """
import sys
from clresample.cli import main
try:
    status = main(sys.argv[1:])
except SystemExit as stop:
    status = stop.code
print("modules:", *sys.modules)
sys.exit(status)
"""


def imported(*arguments):
    """Names of all modules that `clresample ARGUMENTS` imports."""
    answer = run_python("-c", RUN, *map(str, arguments))
    assert answer.returncode == 0, answer.stderr
    return set(answer.stdout.split("modules:")[1].split())


def test_help_imports_nothing_slow():
    for arguments in (["--help"], ["deblend", "--help"], ["resample", "--help"]):
        assert not imported(*arguments) & SLOW


def test_devices_imports_opencl_and_numpy_only():
    assert imported("devices") & SLOW == {"numpy", "pyopencl"}


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The scene file of the example."""
    pytest.importorskip("galsim")
    folder = tmp_path_factory.mktemp("example")
    assert main(["deblend", "--example", str(folder)]) == 0
    return folder / "scene.toml"


@pytest.mark.parametrize("figure", [True, False])
def test_a_fit_imports_what_it_uses(example, tmp_path, figure):
    arguments = ["deblend", example, "-o", tmp_path / "out", "--max-iter", 3]
    if figure:
        pytest.importorskip("matplotlib")
    else:
        arguments.append("--no-figure")
    found = imported(*arguments)
    assert not found & UNUSED
    assert {"matplotlib", "PIL"} <= found if figure else not found & {"matplotlib", "PIL"}


def test_a_slow_import_is_seen():
    answer = run_python("-c", "import scipy.signal, sys; print(*sys.modules)")
    assert set(answer.stdout.split()) & UNUSED
