"""A device in forked processes, and PoCL without a cache that it can write: said, not hung."""

import os
import sys

import pytest
from helpers.checkout import run_python

from clresample import get_device

SET_UP = """
import os, signal, sys
import numpy as np
from clresample import Grid, PSF, Resampler, get_device
device = get_device()
def make():
    fine, coarse = Grid.flat((20, 20), 0.1), Grid.flat((9, 9), 0.2, angle_deg=10)
    return Resampler(fine, PSF.gaussian(1.0, n_pixels=11), coarse, PSF.gaussian(1.0, n_pixels=11))
"""
FORKED = """
op, x = make(), np.ones((1, 20, 20))
before = op(x)
ways = {
    "operator": lambda: op(x), "new": make, "memory": lambda: device.put(x), "wait": device.finish,
    "device": get_device, "given": lambda: get_device(device),
}
for way, call in ways.items():
    if os.fork() == 0:
        signal.alarm(30)
        try:
            call()
        except Exception as error:
            print(way, type(error).__name__, error, flush=True)
        os._exit(0)
    os.wait()
    print(way, "parent", np.array_equal(op(x), before), flush=True)
"""


@pytest.fixture(scope="module")
def forked():
    """{way: lines} of what a process says that forks once for each way to use the device."""
    lines = run_python("-c", SET_UP + FORKED).stdout.splitlines()
    words = [line.partition(" ") for line in lines]
    return {way: [text for key, _, text in words if key == way] for way, _, _ in words}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
@pytest.mark.parametrize("way", ["operator", "new", "device", "given", "memory", "wait"])
def test_a_forked_process_is_told_so(forked, way):
    child, parent = forked[way]
    assert child.startswith("DeviceError ") and "before this process was forked" in child
    assert "spawn" in child
    assert parent == "parent True"


def test_a_process_forked_before_is_fine():
    """The device is opened in the child alone."""
    opened = SET_UP.replace("device = get_device()\n", "if os.fork(): os.wait(); sys.exit()\n")
    answer = run_python("-c", opened + "print(make()(np.ones((20, 20))).shape)")
    assert answer.stdout == "(9, 9)\n"


@pytest.fixture(scope="module")
def pocl():
    """Skips where the CPU's OpenCL is another."""
    if "Portable Computing" not in get_device().platform:
        pytest.skip("the CPU's OpenCL is not PoCL")


@pytest.mark.parametrize(
    "variables, said",
    [
        ({"POCL_CACHE_DIR": "/dev/null/x"}, "cannot write to its cache of built kernels, /dev/nul"),
        ({"XDG_CACHE_HOME": "/dev/null", "POCL_CACHE_DIR": ""}, "/dev/null/pocl (Not a directory)"),
        ({"POCL_CACHE_DIR": "{file}"}, "{file} (File exists): set POCL_CACHE_DIR"),
        ({"POCL_DEVICES": "nonsense"}, "PoCL shows no device for POCL_DEVICES=nonsense"),
    ],
)
def test_a_cache_that_cannot_be_written_is_said(pocl, tmp_path, monkeypatch, variables, said):
    file = tmp_path / "file"
    file.write_text("")
    for name, value in variables.items():
        monkeypatch.setenv(name, value.replace("{file}", str(file)))
    answer = run_python(
        "-c",
        "from clresample import DeviceError, get_device\n"
        "try:\n get_device().launcher('warp.cl', 'gather', N_TAPS=7)\n"
        "except DeviceError as error: print(error)",
    )
    assert said.replace("{file}", str(file)) in answer.stdout
    assert "pip install" not in answer.stdout


def test_a_home_that_cannot_be_written_hides_no_device(tmp_path):
    """PoCL's cache is elsewhere, as its message says; pyopencl and clresample keep nothing."""
    nowhere = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "CLRESAMPLE_CACHE"), "/proc/nobody")
    answer = run_python(
        "-c",
        SET_UP + "print(make()(np.ones((20, 20))).shape)",
        POCL_CACHE_DIR=str(tmp_path),
        **nowhere,
    )
    said = [line for line in answer.stderr.splitlines() if "shader cache" not in line]  # Mesa's
    assert (answer.stdout, said) == ("(9, 9)\n", [])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux holds it")
@pytest.mark.parametrize("space", [450, 600, 750])
def test_too_little_address_space_is_said(space):
    """In one line; drivers abort, hang or are not found."""
    held = (
        "import resource, sys; from clresample.cli import main\n"
        f"resource.setrlimit(resource.RLIMIT_AS, ({space} << 20,) * 2)\n"
        "sys.exit(main(['devices']))"
    )
    answer = run_python("-c", held)
    assert answer.returncode == 2
    assert answer.stderr.startswith(f"clresample devices: this process may have {space} MiB of add")
    assert answer.stderr.count("\n") == 1


def test_enough_address_space_is_taken():
    held = "import resource; resource.setrlimit(resource.RLIMIT_AS, (3 << 30,) * 2)\n"
    answer = run_python("-c", held + SET_UP + "print(make()(np.ones((20, 20))).shape)")
    assert answer.stdout == "(9, 9)\n", answer.stderr
