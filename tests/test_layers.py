"""The layers: who may import whom, no circles, and nothing too long to read.

Packages are the folders of clresample/; a package may import the packages named beside it here, and
itself.
"""

import ast
import functools
import subprocess
import sys
import warnings

import pytest
from helpers.checkout import ROOT

ALLOWED_IMPORTS = {
    "device": ("drawing",),
    "drawing": (),
    "sky": ("drawing",),
    "resampling": ("device", "drawing", "sky"),
    "adapters": ("sky", "resampling"),
    "deblending": ("device", "drawing", "sky", "resampling", "adapters"),
    "paper": ("device", "drawing", "sky", "resampling", "deblending"),
    "measurement": ("drawing", "sky", "resampling", "deblending"),
    "files": ("drawing", "sky", "deblending", "measurement"),
    "simulation": ("sky",),
    "fields": ("device", "sky", "resampling", "deblending", "paper", "measurement", "files"),
    "report": ("device", "sky", "measurement", "files", "fields"),
    "cli": (
        "device",
        "drawing",
        "sky",
        "resampling",
        "deblending",
        "paper",
        "measurement",
        "files",
        "simulation",
        "fields",
        "report",
    ),
}
# Packages of deblending that know nothing of the fits around them, and what they import of it.
DEBLENDING = "clresample.deblending."
INNER_IMPORTS = {
    "linear.": ("component_images", "profiles", "sersic", "view"),
    "solver.": ("linear.",),
}
# Packages that work without any OpenCL driver.
NUMPY_ONLY = ("sky", "simulation")
# Over a limit the test fails; over what is enough for nearly all it warns.
MAX_LINES, MAX_CLASS, MAX_FUNCTION, MAX_FILES, MAX_FOLDERS = 450, 220, 90, 24, 13
ENOUGH_LINES, ENOUGH_CLASS, ENOUGH_FUNCTION, ENOUGH_FILES = 300, 150, 60, 20

PACKAGE = ROOT / "clresample"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
SOURCES = [
    path
    for folder in ("clresample", "tests", "bench", "docs", "kernels")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".cl", ".h")
]
KEPT = ast.Import, ast.ImportFrom, ast.ClassDef, ast.FunctionDef


@functools.cache
def parsed(source):
    """Imports, classes and functions of a Python source, inside others too; no expressions."""
    found, left = [], [ast.parse(source)]
    while left:
        node = left.pop()
        found += [node] if isinstance(node, KEPT) else []
        inner = ast.iter_child_nodes(node)
        left += (n for n in inner if isinstance(n, (ast.stmt, ast.excepthandler, ast.match_case)))
    return found


def imported(name, source, is_package=False):
    """Every module that module `name` imports, at the top or inside functions, in full."""
    home = name.split(".") if is_package else name.split(".")[:-1]
    for node in parsed(source):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = home[: len(home) - node.level + 1] if node.level else []
            base = ".".join([*base, *filter(None, [node.module])])
            members = [f"{base}.{alias.name}" for alias in node.names]
            inside = [member for member in members if member in MODULES]
            yield from inside or [base]


def package_of(name):
    """The package of a module of clresample's; "" for those beside the packages."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in ALLOWED_IMPORTS else ""


def violations(name, source, is_package=False):
    """The imports in `source`, the text of module `name`, that its package does not allow."""
    package = package_of(name)
    for target in imported(name, source, is_package):
        if target.split(".")[0] == "pyopencl" and package in NUMPY_ONLY:
            yield target
        if target.split(".")[0] != "clresample" or target == "clresample":
            continue
        if package_of(target) != package and package_of(target) not in ALLOWED_IMPORTS.get(
            package, ()
        ):
            yield target
        for inside, allowed in INNER_IMPORTS.items():
            within = tuple(DEBLENDING + other for other in (inside, *allowed))
            leaves = target.startswith(DEBLENDING) and not target.startswith(within)
            if name.startswith(DEBLENDING + inside) and leaves:
                yield target


def graph():
    """Modules of clresample that each of them imports."""
    return {
        name: {
            target
            for target in imported(name, path.read_text(), path.stem == "__init__")
            if target in MODULES and target not in ("clresample", name)
        }
        for name, path in MODULES.items()
        if name != "clresample"  # names all public modules, imports none before they are used
    }


def find_circle(imports):
    """Modules that import each other in a circle, or None."""
    done = set()

    def walk(name, way):
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done:
            return None
        circle = next(filter(None, (walk(n, [*way, name]) for n in imports.get(name, ()))), None)
        done.add(name)
        return circle

    return next(filter(None, (walk(name, []) for name in imports)), None)


def too_long(source, max_class=MAX_CLASS, max_function=MAX_FUNCTION):
    """Classes and functions of a Python source that are over the limits, with their lengths."""
    for node in parsed(source):
        n_lines = node.end_lineno - node.lineno + 1
        if isinstance(node, ast.ClassDef) and n_lines > max_class:
            yield f"class {node.name}: {n_lines} lines"
        if isinstance(node, ast.FunctionDef) and n_lines > max_function:
            yield f"{node.name}: {n_lines} lines"


def test_imports_only_reach_down():
    sources = {name: (path.read_text(), path.stem == "__init__") for name, path in MODULES.items()}
    found = {name: list(violations(name, *sources[name])) for name in MODULES if "." in name}
    assert len(found) > 300 and not {name: upward for name, upward in found.items() if upward}


def test_there_is_no_circle():
    assert find_circle(graph()) is None


def test_nothing_is_too_long():
    found = {}
    for path in SOURCES:
        source, name = path.read_text(), path.relative_to(ROOT)
        n_lines = len(source.splitlines())
        python = source if path.suffix == ".py" else ""
        found[name] = [f"{n_lines} lines"] if n_lines > MAX_LINES else []
        found[name] += too_long(python)
        large = [f"{n_lines} lines"] if n_lines > ENOUGH_LINES else []
        large += too_long(python, ENOUGH_CLASS, ENOUGH_FUNCTION)
        if large:
            warnings.warn(f"{name}: {', '.join(large)}", stacklevel=1)
    assert len(found) > 700 and not {name: lines for name, lines in found.items() if lines}


def test_the_house_has_few_rooms_with_few_files():
    packages = [path for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"]
    assert {path.name for path in packages} - {"kernels"} == set(ALLOWED_IMPORTS)
    assert len(packages) <= MAX_FOLDERS
    for folder in {path.parent for path in MODULES.values()} - {PACKAGE}:
        n_files, n_folders = (len(list(folder.glob(name))) for name in ("*.py", "*/__init__.py"))
        assert n_files != 2 or n_folders, f"{folder} holds one file beside __init__.py"
        assert n_files <= MAX_FILES, folder
        if n_files > ENOUGH_FILES:
            warnings.warn(f"{folder.relative_to(ROOT)}: {n_files} files", stacklevel=1)


@pytest.mark.parametrize("package", ALLOWED_IMPORTS)
def test_each_room_says_what_it_holds(package):
    text = ast.get_docstring(ast.parse((PACKAGE / package / "__init__.py").read_text()))
    assert text
    assert "import" in text.lower()


@pytest.mark.parametrize(
    "line",
    [
        "import pyopencl.array",
        "from pyopencl import array",
        "from ..device.device import get_device",
        "from ..device import device",
        "def f():\n    from clresample.device.device import get_device",
        "import clresample.resampling.linop",
    ],
)
def test_an_upward_import_is_seen(line):
    assert list(violations("clresample.sky.psf", line))


@pytest.mark.parametrize("module", ["solver.gradient", "linear.normal"])
def test_inner_packages_are_kept_from_the_fits_around_them(module):
    name = f"clresample.deblending.{module}"
    for upward in ("from ..fit import Fit", "from ..posterior.modes import Solution"):
        assert list(violations(name, upward))
    assert not list(violations(name, "from ..linear.ties import Ties"))


def test_linear_is_below_the_solver():
    name = "clresample.deblending.linear.ties"
    assert list(violations(name, "from ..solver.boxes import Boxes"))
    assert not list(violations(name, "from ..view import WhitenedView"))


def test_a_circle_is_seen():
    assert find_circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})
    assert find_circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) is None


def test_length_is_seen():
    body = "\n".join(["    x = 1"] * MAX_FUNCTION)
    assert list(too_long(f"def f():\n{body}\n"))
    assert not list(too_long(f"def f():\n{body[10:]}\n"))


def test_import_alone_leaves_opencl_alone():
    code = "import sys, clresample.cli; sys.exit('pyopencl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
