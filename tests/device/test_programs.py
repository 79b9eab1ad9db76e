"""Programs that are built ahead, in a thread, are those that operators ask for, built once."""

import threading
from collections import Counter

import numpy as np
import pytest

from clresample.device.device import Device
from clresample.device.discovery import DeviceError
from clresample.device.mirror_contraction import operator_programs
from clresample.device.program import Programs
from clresample.resampling.resampler import Resampler
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


@pytest.fixture
def fresh(device):
    """The same device as one that has built nothing."""
    return Device(device.cl)


@pytest.fixture
def built(monkeypatch):
    """Number of builds of each program, by (file, dtype, macros)."""
    counts, build = Counter(), Programs._built

    def counted(self, file, dtype, defines):
        counts[file, np.dtype(dtype), tuple(sorted(defines.items()))] += 1
        return build(self, file, dtype, defines)

    monkeypatch.setattr(Programs, "_built", counted)
    return counts


def turned_operator(device):
    wide = Grid.flat((12, 14), 0.2, angle_deg=20)
    return Resampler(
        Grid.flat((24, 28), 0.1), PSF.gaussian(0.8), wide, PSF.gaussian(1.5), device=device
    )


@pytest.mark.parametrize("ahead", [False, True])
def test_an_operator_builds_what_was_listed(fresh, built, ahead):
    listed = {
        (file, np.dtype(dtype), tuple(sorted(macros.items())))
        for file, dtype, macros in operator_programs(fresh, np.float32)
    }
    if ahead:
        fresh.build_ahead(operator_programs(fresh, np.float32))
    turned = turned_operator(fresh)
    inside = Grid.flat((8, 9), 0.2)
    aligned = Resampler(Grid.flat((24, 28), 0.1), PSF.gaussian(0.8), inside, PSF.gaussian(1.5))
    for op in (turned, Resampler.from_plans(aligned.plans, device=fresh)):
        op.adjoint(op(np.ones((24, 28))))
    contractions = {request for request in built if request[0].startswith(("contract", "mirror"))}
    assert _of_any_tile(contractions) == _of_any_tile(listed)
    assert set(built.values()) == {1}


def _of_any_tile(requests):
    """Without the sizes of a tile: GPUs choose its rows by the matrix, CPUs its columns."""
    sizes = {"MR", "NV", "VW"}
    return {(*rest, tuple(m for m in macros if m[0] not in sizes)) for *rest, macros in requests}


def test_one_that_is_being_built_is_waited_for(fresh, monkeypatch):
    started, build = threading.Event(), Programs._built

    def slow(self, file, dtype, defines):
        started.set()
        threading.Event().wait(0.2)
        return build(self, file, dtype, defines)

    monkeypatch.setattr(Programs, "_built", slow)
    fresh.build_ahead([("warp.cl", "float32", {"N_TAPS": 4})])
    assert started.wait(10)
    monkeypatch.setattr(Programs, "_built", None)  # would fail if it were called again
    assert repr(fresh.launcher("warp.cl", "gather", N_TAPS=4)) == "Launcher(gather)"


def test_an_error_waits_for_the_one_who_asks(fresh):
    fresh.build_ahead([("warp.cl", "float32", {"N_TAPS": "no number"})])
    for _ in range(2):
        with pytest.raises(DeviceError, match="does not build"):
            fresh.launcher("warp.cl", "gather", N_TAPS="no number")
