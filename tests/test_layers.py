"""Who may import whom: a module only reaches down, and the NumPy layer knows no OpenCL."""

import ast
import subprocess
import sys

import pytest
from conftest import ROOT

# From the ground up; a module may import from its own layer and from those before it.
LAYERS = [
    {
        "grid",
        "mapping",
        "psf",
        "lines",
        "spectrum",
        "observation",
        "sources",
        "frame",
        "result",
        "profiles",
        "shapes",
        "footprint",
        "boxes",
        "solve",
        "surveys",
        "tiling",
        "galaxies",
        "reference",
        "reference_prox",
        "reference_scene",
        "curvature",
    },
    {"discover", "device"},
    {"contract", "factors", "linop", "paths", "sincs", "testing"},
    {"resample", "split", "scene", "operators", "prox", "tiles"},
    {
        "problem",
        "spectra",
        "initialize",
        "image_start",
        "shifts",
        "resize",
        "engine",
        "fit",
        "joint",
        "detect",
        "measure",
    },
    {
        "io",
        "store",
        "simulate",
        "plot",
        "demo",
        "demo_resample",
        "cli",
        "cli_options",
        "cli_resample",
        "cli_deblend",
        "scenefile",
        "scenekeys",
        "source_table",
        "example",
        "plot_deblended",
    },
]
RANKS = {name: rank for rank, names in enumerate(LAYERS) for name in names}
MODULES = sorted((ROOT / "clresample").glob("*.py"))


def imported(tree):
    """Every module that a syntax tree imports, at the top or inside functions, written in full."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            home = ".".join(filter(None, ["clresample" * bool(node.level), node.module]))
            yield home
            if home == "clresample":  # from . import psf
                yield from (f"clresample.{alias.name}" for alias in node.names)


def violations(name, source):
    """The imports in `source`, the text of module `name`, that its layer does not allow."""
    rank = RANKS[name]
    for target in imported(ast.parse(source)):
        package, _, module = target.partition(".")
        if package == "pyopencl" and rank == 0:
            yield target
        if package == "clresample" and RANKS.get(module.split(".")[0], -1) > rank:
            yield target


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_imports_only_reach_down(path):
    if path.stem == "__init__":
        pytest.skip("names the modules, imports none before they are used")
    assert path.stem in RANKS, f"give {path.name} a layer in {__file__}"
    assert not list(violations(path.stem, path.read_text()))


@pytest.mark.parametrize(
    "line",
    [
        "import pyopencl.array",
        "from pyopencl import array",
        "from .device import get_device",
        "from . import device",
        "def f():\n    from clresample.device import get_device",
        "import clresample.linop",
    ],
)
def test_an_upward_import_is_seen(line):
    assert list(violations("psf", line))


def test_import_alone_leaves_opencl_alone():
    code = "import sys, clresample.cli; sys.exit('pyopencl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
