"""Fixture of the tests of solvers: both builds of their kernels."""

import pytest


@pytest.fixture(params=["rows", "groups"])
def build(request, device, monkeypatch):
    """The device with the build for CPUs, or with that for GPUs: an item a pixel, 64 a sum."""
    if request.param == "groups":
        if device.kind != "CPU":
            pytest.skip("this device's own")
        monkeypatch.setattr(device, "kind", "GPU")  # what Tuning.of asks for
    return device
