"""Fixtures: every OpenCL device of the machine, and the folder of real images.

Options: --as-gpu runs every device through the kernels as they are built for GPUs; --nan-buffers
fills each new buffer of a device with NaN, so that a kernel that reads what nobody wrote is found;
--guard-buffers fails tests whose kernels write beyond the end of a buffer.
"""

import functools
import gc
import os
import shutil
import signal
from pathlib import Path

# Before NumPy is loaded: on small matrices BLAS threads only wait for each other, and for PoCL's.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# What the user's own devices were tuned to is no matter of the tests. Processes that tests start
# have the same folder; it is removed at the end, or by the next run where this one is killed.
from clresample.device.drivers import temporary_folder

os.environ["CLRESAMPLE_CACHE"] = str(temporary_folder("cache"))

import numpy as np
import pytest
from helpers.buffers import Guards, fill_with_nan
from helpers.checkout import ROOT

from clresample import Device, DeviceError, get_device, list_devices

# Shells start what runs in the background with Ctrl-C ignored, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ("helpers.builds", "helpers.field_run")  # fixtures of several folders
NO_DOUBLE = "has no double precision: use float32"


def pytest_addoption(parser):
    parser.addoption("--as-gpu", action="store_true", help="build kernels as for GPUs")
    parser.addoption("--nan-buffers", action="store_true", help="fill new buffers with NaN")
    parser.addoption("--guard-buffers", action="store_true", help="find writes beyond buffers")


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        found = _devices()
        metafunc.parametrize("device", found.values(), ids=found, indirect=True, scope="session")


def pytest_collection_finish(session):
    """Makes collections of garbage quick: they take half a second where they walk all the tests."""
    gc.collect()
    gc.freeze()


@functools.cache
def _devices():
    """{name of a test's parameter: index} of every device; asking builds a kernel for each."""
    try:
        return {f"{info.index}-{info.name.split()[0]}": info.index for info in list_devices()}
    except DeviceError:
        return {"none": None}  # then the fixture fails and says why, instead of skipping


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem):
    """Skips a test that asks a device for float64 which it does not have."""
    try:
        return (yield)
    except DeviceError as error:
        _skip_without_double(error, pyfuncitem)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    """And one of whose fixtures does."""
    try:
        return (yield)
    except DeviceError as error:
        _skip_without_double(error, item)


def _skip_without_double(error, item):
    if NO_DOUBLE not in str(error) or _asks_for_single(item):
        raise error
    pytest.skip(str(error))


def _asks_for_single(item):
    """True of a test whose parameters say float32: such a test has no use for float64."""
    dtype = getattr(item, "callspec", None) and item.callspec.params.get("dtype")
    return dtype is not None and np.dtype(dtype) == np.float32


@pytest.fixture(scope="session")
def device(request):
    """Each OpenCL device in turn."""
    return get_device(request.param)


@pytest.fixture(scope="session", autouse=True)
def as_asked(request):
    """Applies the options to all devices; yields the Guards, if they were requested."""
    with pytest.MonkeyPatch.context() as patch:
        if request.config.getoption("--as-gpu"):
            opened = Device.__init__

            def as_gpu(self, cl_device):
                opened(self, cl_device)
                self.kind = "GPU"

            patch.setattr(Device, "__init__", as_gpu)
        if request.config.getoption("--nan-buffers"):
            fill_with_nan(patch)
        yield Guards(patch) if request.config.getoption("--guard-buffers") else None
    shutil.rmtree(os.environ["CLRESAMPLE_CACHE"], ignore_errors=True)


@pytest.fixture(autouse=True)
def within_buffers(request, as_asked):
    """With --guard-buffers: no kernel wrote beyond the end of a buffer."""
    if as_asked is not None and request.node.get_closest_marker("counts_memory"):
        pytest.skip("guarded buffers are larger, and stay until their test has ended")
    yield
    if as_asked is not None:
        assert as_asked.overwritten() == [], "bytes of buffers that were written beyond their end"


@pytest.fixture(scope="session")
def data():
    """The folder of real images and catalogues: CLRESAMPLE_DATA, or one beside the checkout."""
    folder = Path(os.environ.get("CLRESAMPLE_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder}: set CLRESAMPLE_DATA to test on real images")
    return folder
