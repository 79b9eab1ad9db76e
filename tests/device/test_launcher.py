"""Kernels launched by the names of their arguments, and the mistakes that are refused."""

import gc
import keyword
import re
import threading
import time

import numpy as np
import pytest
from helpers.checkout import ROOT, run_python

from clresample import DeviceError
from clresample.device.device import Device
from clresample.device.program import signature

TYPES = [np.float32, np.float64]
ALL = [
    (path.name, name)
    for path in sorted((ROOT / "kernels").glob("*.cl"))
    for name in re.findall(r"__kernel\b[^;{]*?\bvoid\s+(\w+)", path.read_text())
]


@pytest.fixture
def mixed(device, kernels):
    """A launcher of `mixed` with all but x and out bound: out[i] = 3 x[2 i + 1] + 7, i < 10."""
    launch = device.launcher("mixed.cl", "mixed", local_size=(1,))
    return launch.bind(n=10, first=1, factor=3.0, add=7, step=2)


@pytest.mark.smoke
@pytest.mark.parametrize("dtype", TYPES)
def test_arguments_of_every_type_by_name(device, kernels, dtype):
    if dtype == np.float64 and not device.has_fp64:
        with pytest.raises(DeviceError, match="no double precision: use float32"):
            device.launcher("mixed.cl", "mixed", dtype=dtype)
        return
    x = np.linspace(0, 1, 30).astype(dtype)
    array, out = device.put(x), device.zeros(12, dtype)
    # in any order, NumPy's numbers and Python's, bound or not, what is bound first replaced
    launch = device.launcher("mixed.cl", "mixed", dtype=dtype, local_size=(1,))
    launch.bind(step=np.int64(2), x=array, add=5, factor=np.float32(3)).bind(add=np.uint8(7), n=10)
    launch((12,), out=out, first=1)
    truth = np.where(np.arange(12) < 10, 3 * x[1:25:2] + 7, 0)
    np.testing.assert_allclose(device.get(out), truth, rtol=2 * np.finfo(dtype).eps)
    launch((12,), out=out.base_data, first=0, factor=0.5)  # of this launch alone
    np.testing.assert_allclose(device.get(out)[:10], 0.5 * x[:20:2] + 7, rtol=3e-7)
    launch((12,), out=out, first=1)
    np.testing.assert_allclose(device.get(out), truth, rtol=2 * np.finfo(dtype).eps)


def test_mistakes_name_the_argument(device, kernels, mixed):
    x = device.zeros(30, np.float32)
    with pytest.raises(ValueError, match=r"Launcher\(mixed\) takes n, x, .* step, not q"):
        mixed.bind(q=1)
    with pytest.raises(ValueError, match="not q"):
        mixed((1,), q=1)
    with pytest.raises(ValueError, match="was not given x, out"):
        mixed((1,))
    with pytest.raises(ValueError, match="was not given out"):
        mixed((1,), x=x)
    with pytest.raises(ValueError, match="x of .* starts at byte 16 of its buffer"):
        mixed.bind(x=x[4:])
    for wrong in ({"n": 1 << 31}, {"n": 1.5}, {"n": None}, {"first": -1}, {"x": 5}):
        with pytest.raises(Exception) as refusal:
            mixed((1,), **{"x": x, "out": x, **wrong})
        assert "arguments of Launcher(mixed): n, x, first" in refusal.value.__notes__[0]
    mixed((1,), x=x, out=x)  # a mistake leaves nothing behind


def test_unknown_kernels_and_types_are_refused(device, kernels):
    with pytest.raises(ValueError, match=r"kernels/mixed\.cl has no kernel mix$"):
        device.launcher("mixed.cl", "mix")
    with pytest.raises(ValueError, match="unknown of kernels/mixed.cl: argument type char"):
        device.launcher("mixed.cl", "unknown")
    with pytest.raises(ValueError, match="dtype is int32; .* float32 or float64"):
        device.launcher("mixed.cl", "mixed", dtype=np.int32)
    with pytest.raises(FileNotFoundError):
        device.launcher("absent.cl", "mixed")


@pytest.mark.counts_memory
def test_bound_arrays_stay_and_those_of_a_call_do_not(device, kernels, mixed):
    gc.collect()
    before = device.in_use
    mixed.bind(x=device.put(np.arange(30, dtype=np.float32)))
    gc.collect()
    assert device.in_use == before + 120
    for _ in range(3):  # what was freed would be written over
        device.put(np.full(30, 1e9, np.float32))
    out = device.zeros(10, np.float32)
    mixed((10,), out=out)
    np.testing.assert_array_equal(device.get(out), 3 * (2 * np.arange(10) + 1) + 7)
    del out
    gc.collect()
    assert device.in_use == before + 120
    mixed.bind(x=None)
    gc.collect()
    assert device.in_use == before


def test_one_build_serves_many_launchers(device, kernels, mixed):
    x = device.put(np.arange(30, dtype=np.float32))
    out = [device.zeros(10, np.float32) for _ in range(2)]
    twin = device.launcher("mixed.cl", "mixed", local_size=(1,))
    assert twin.kernel is mixed.kernel
    assert device.launcher("mixed.cl", "other").kernel.program == mixed.kernel.program
    assert device.launcher("mixed.cl", "mixed", FAST=True).kernel.program != mixed.kernel.program
    mixed.bind(x=x, out=out[0])
    twin.bind(x=x, out=out[1], n=10, first=0, factor=1.0, add=0, step=1)
    for launch in (mixed, twin, mixed):
        launch((10,))
    np.testing.assert_array_equal(device.get(out[0]), 3 * (2 * np.arange(10) + 1) + 7)
    np.testing.assert_array_equal(device.get(out[1]), np.arange(10))


def test_threads_do_not_mix_their_arguments(device, kernels, monkeypatch):
    """Between setting and queueing nobody else sets: without the lock both write the last array."""
    launch = Device.launch

    def slow(*arguments):
        time.sleep(0.05)
        launch(*arguments)

    monkeypatch.setattr(Device, "launch", slow)
    x = device.put(np.ones(4, np.float32))
    out = [device.zeros(4, np.float32) for _ in range(3)]
    threads = [
        threading.Thread(target=device.launcher("scale.cl", "scale"), args=((4,),), kwargs=given)
        for given in ({"x": x, "out": array} for array in out)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all((device.get(array) == 2).all() for array in out)


@pytest.mark.parametrize(("file", "name"), ALL)
def test_every_kernel_can_be_launched_by_name(device, file, name):
    """Each file builds with its own defaults; pyopencl counts as many arguments as are read."""
    launch = device.launcher(file, name)
    names = [argument for argument, _ in signature(file, name)]
    assert launch.kernel.num_args == len(names) == len(set(names))
    assert all(argument.isidentifier() and not keyword.iskeyword(argument) for argument in names)


BUILT = """
import sys
from clresample import get_device
from clresample.device.program import read_kernel
device = get_device("portable")
for pair in sys.argv[1:]:
    file, name = pair.split(":")
    device.launcher(file, name, **{"ROWS": True} if "ifndef ROWS" in read_kernel(file) else {})
"""


def test_compilers_have_nothing_to_say(device, tmp_path):
    """PoCL's writes warnings into the terminal of whoever builds a kernel first."""
    if "Portable" not in device.platform:
        pytest.skip("for PoCL")
    of_each_file = [f"{file}:{name}" for file, name in dict(ALL).items()]
    answer = run_python("-c", BUILT, *of_each_file, POCL_CACHE_DIR=str(tmp_path))
    assert (answer.returncode, answer.stderr) == (0, "")


def test_the_names_are_those_of_the_source():
    assert len(ALL) > 20
    assert signature("warp.cl", "rowdot")[:2] == (("n_positions", "int"), ("n_pad", "int"))
    assert dict(signature("contract.cl", "contract"))["offset_a"] == "ulong"
    assert dict(signature("prox.cl", "chain"))["step"] == "REAL"
    assert dict(signature("prox.cl", "chain"))["x"] is None
