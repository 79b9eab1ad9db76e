"""Rules of all kernel sources: each builds on any device and can be read alone."""

import re

import numpy as np
import pytest
from helpers.checkout import ROOT

from clresample.deblending.solver.boxes import COLUMNS
from clresample.deblending.solver.rendering import boxed
from clresample.device.tuning import Tuning

FILES = {path.name: path.read_text() for path in sorted((ROOT / "kernels").iterdir())}
MAX_COLUMNS = 100
# Set by the host for each build, see common.h; steps of a chain, which may be missing.
NO_DEFAULT = {"USE_DOUBLE", *(f"STEP{k}" for k in range(8))}

every_file = pytest.mark.parametrize("file", FILES)


def code(text):
    """A source without its comments."""
    return re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)


def stray_restricts(text):
    """`restrict` that is not on an argument of a kernel: Oclgrind cannot build it."""
    return re.sub(r"__kernel\b[^;{]*?\([^{]*?\)\s*\{", "", code(text)).count("restrict")


def variadic_macros(text):
    """Macros of variable numbers of arguments: OpenCL C has none, NVIDIA's driver refuses them."""
    return re.findall(r"\.\.\.\s*\)|__VA_ARGS__", code(text))


def without_default(text):
    """Macros that decide what is compiled, and have no value of their own."""
    asked = re.findall(r"^#\s*(?:if|elif|ifdef)\b(.*)$", code(text), re.MULTILINE)
    asked = {name for line in asked for name in re.findall(r"[A-Z][A-Z0-9_]+", line)}
    return asked - set(re.findall(r"^#ifndef (\w+)", text, re.MULTILINE)) - NO_DEFAULT


def whole(file):
    """A source with the files that it includes, and those that they include."""
    return re.sub(r'^#include "(.+)"$', lambda m: whole(m[1]), FILES[file], flags=re.MULTILINE)


@every_file
def test_lines_fit_a_page(file):
    assert not [line for line in FILES[file].splitlines() if len(line) > MAX_COLUMNS]


@every_file
def test_restrict_is_on_kernels_own_arguments(file):
    assert not stray_restricts(FILES[file])


@every_file
def test_macros_have_fixed_numbers_of_arguments(file):
    assert not variadic_macros(FILES[file])


@every_file
def test_every_macro_has_a_value_of_its_own(file):
    users = [file] if file.endswith(".cl") else [f for f in FILES if f'"{file}"' in FILES[f]]
    assert users
    for user in users:
        assert not without_default(whole(user))


@every_file
def test_every_default_says_what_it_is(file):
    lines = re.findall(r"^#ifndef .*$", FILES[file], re.MULTILINE)
    assert all(re.fullmatch(r"#ifndef \w+\s+/\* .+ \*/", line) for line in lines)


def test_columns_are_those_of_the_table():
    names = re.search(r"enum \{ (.*?), N_COLUMNS \}", FILES["boxes.h"])[1].split(", ")
    assert [name.lower() for name in names] == [column.split(" /")[0] for column in COLUMNS]
    names = re.search(r"enum \{ (.*?), N_COLUMNS \}", FILES["boxed.cl"])[1].split(", ")
    assert [name.lower() for name in names] == boxed.COLUMNS


def test_no_column_is_a_bare_number():
    for file, text in FILES.items():
        if '"boxes.h"' in text:
            assert not re.search(r"\bbox\[\d|\btable\[|\* 16\b|/ 16\b", code(text)), file


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_sizes_are_macros_that_kernels_take(device, monkeypatch, kind, dtype):
    monkeypatch.setattr(device, "kind", kind)
    monkeypatch.setattr(device, "simulated", False)
    tuning = Tuning.of(device, dtype)
    for name, size in tuning.tile.items():
        assert f"#ifndef {name} " in whole(
            "contract_group.cl" if "KB" in tuning.tile else "contract.cl"
        )
        assert size >= 1
    assert tuning.tile["MR"] % 2 == 0  # (cos, sin) pairs stay together
    assert 16 % tuning.tile["VW"] == 0  # columns are padded to 16
    assert tuning.tile["WGX"] * tuning.tile["WGY"] <= 64  # what every GPU allows
    assert tuning.lanes in (4, 8, 16)
    assert tuning.memory <= device.memory // 4
    for n_axes in (1, 3):  # none is left to the driver
        group = tuning.local_size(n_axes)
        assert len(group) == n_axes
        assert np.prod(group) == (1 if kind == "CPU" else 64)


@pytest.mark.parametrize("words", [r"set_args?\(", "set_scalar_arg_dtypes", r"device\.kind\b"])
def test_one_package_sets_arguments_and_reads_the_kind_of_device(words):
    """Arguments go by name, and what depends on the device is in Tuning."""
    files = (ROOT / "clresample").rglob("*.py")
    packages = {path.parent.name for path in files if re.search(words, path.read_text())}
    assert packages - {"device_tools"} == {"device"}  # `clresample tune` keeps its finds by kind


def test_faults_are_seen():
    assert stray_restricts("static void f(__global int *restrict x) {}")
    assert not stray_restricts("__kernel void f(__global int *restrict x)\n{ g(x); }")
    assert variadic_macros("#define EACH(f, ...) f(0, __VA_ARGS__)")
    assert without_default("#if FAST\n#endif") == {"FAST"}
    assert not without_default("#ifndef FAST /* quick */\n#define FAST 0\n#endif\n#if FAST\n#endif")
