"""Blends of one call on processes that share a CPU's cores."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from clresample import DeviceError, FunctionPSF, Settings, deblend_many
from clresample.cli.device_tools.workload import blends
from clresample.deblending import batch, processes

SETTINGS = Settings(max_iter=4)
# Without `if __name__ == "__main__":`. Its second print would come from each process that imports
# it.
SCRIPT = """
from clresample import Settings, deblend_many, get_device
from clresample.cli.device_tools.workload import blends

print("imported")
results = deblend_many(
    blends(4, get_device()), settings=Settings(max_iter=4), processes=2, progress=print
)
print(*(result.losses[-1] for result in results))
"""


def test_a_script_needs_no_guard_and_results_are_those_of_one_process(device, tmp_path):
    """To rounding: groups of two blends start equal to 1e-7 of those of four."""
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "-W", "ignore", str(tmp_path / "script.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert not done.stderr
    first, *progress, losses = done.stdout.splitlines()
    assert first == "imported" and progress == ["2", "4"]
    alone = deblend_many(blends(4, device), settings=SETTINGS, processes=1)
    expected = [result.losses[-1] for result in alone]
    np.testing.assert_allclose([float(loss) for loss in losses.split()], expected, rtol=1e-4)


@pytest.fixture
def many(monkeypatch):
    """A CPU of four cores and free memory."""
    monkeypatch.setattr(processes, "n_beside", lambda device: 4)


@pytest.mark.parametrize("n, expected", [(33, 1), (34, 2), (50, 3), (100, 4)])
def test_each_process_gets_enough_sources(device, many, n, expected):
    """Of blends of three sources."""
    (blend,) = blends(1, device)
    assert processes.n_processes([blend] * n, device, SETTINGS) == expected


def test_one_process_in_those_of_multiprocessing(device, many, monkeypatch):
    monkeypatch.setattr(processes.multiprocessing, "parent_process", lambda: object())
    assert processes.n_processes(blends(1, device) * 100, device, SETTINGS) == 1


def psf_of_a_script(y, x):
    raise NotImplementedError


psf_of_a_script.__module__ = "__main__"


@pytest.mark.parametrize("function", [psf_of_a_script, lambda y, x: None])
def test_blends_that_need_the_script_stay_in_its_process(device, many, function, monkeypatch):
    (blend,) = blends(1, device)
    assert processes.can_be_sent([blend])
    monkeypatch.setattr(sys.modules["__main__"], "psf_of_a_script", function, raising=False)
    wrong = replace(blend, observations=(FunctionPSF(function),))
    assert not processes.can_be_sent([blend, wrong])
    assert processes.n_processes([wrong] * 100, device, SETTINGS) == 1
    assert processes.n_processes([blend] * 100, device, function) == 1


def test_fits_go_on_here_if_no_process_does(device, monkeypatch):
    def fails(*_, **__):
        raise DeviceError("all have ended")

    monkeypatch.setattr(batch, "distribute", fails)
    (result,) = deblend_many(blends(1, device), settings=SETTINGS, processes=2)
    assert result.status != "failed"


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "2", True])
def test_refuses_other_numbers(device, wrong):
    with pytest.raises(ValueError, match="processes is "):
        deblend_many(blends(1, device), processes=wrong)


def test_refuses_processes_of_a_list_of_devices(device):
    with pytest.raises(ValueError, match="processes is 2, must be left out with a list"):
        deblend_many(blends(1, device), device=[device], processes=2)
