"""Fixtures: every OpenCL device of the machine, and the folder of real images."""

import os
from pathlib import Path

# Before NumPy is loaded: on small matrices BLAS threads only wait for each other, and for PoCL's.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from helpers.checkout import ROOT

from clresample import DeviceError, get_device, list_devices


def pytest_generate_tests(metafunc):
    if "device" not in metafunc.fixturenames:
        return
    try:
        found = {f"{info.index}-{info.name.split()[0]}": info.index for info in list_devices()}
    except DeviceError:
        found = {"none": None}  # then the fixture fails and says why, instead of skipping
    metafunc.parametrize("device", found.values(), ids=found, indirect=True, scope="session")


@pytest.fixture(scope="session")
def device(request):
    """Each OpenCL device in turn."""
    return get_device(request.param)


@pytest.fixture(scope="session")
def data():
    """The folder of real images and catalogues: CLRESAMPLE_DATA, or one beside the checkout."""
    folder = Path(os.environ.get("CLRESAMPLE_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder}: set CLRESAMPLE_DATA to test on real images")
    return folder
