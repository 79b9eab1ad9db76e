"""The choice of a device, and the table of devices."""

import pyopencl as cl
import pytest
from helpers.checkout import run_python

from clresample import DeviceError, get_device, list_devices
from clresample.cli.command import main
from clresample.device import discovery as discover


def test_one_object_per_device(device):
    assert get_device(device) is device
    assert get_device(device.cl.platform.name + ":" + device.name) is device


def test_every_form_of_choice(monkeypatch):
    for variable in ("CLRESAMPLE_DEVICE", "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    default = get_device()
    info = next(info for info in list_devices() if info.chosen)
    assert info.name == default.name
    part = default.name[2:].upper()
    for choice in (info.index, str(info.index), part, f"{default.platform[:6]}:{part}"):
        assert get_device(choice).name == default.name
        monkeypatch.setenv("CLRESAMPLE_DEVICE", str(choice))
        assert get_device().name == default.name
    monkeypatch.setenv("PYOPENCL_CTX", "no such platform")
    assert get_device().name == default.name  # CLRESAMPLE_DEVICE goes first
    monkeypatch.delenv("CLRESAMPLE_DEVICE")
    with pytest.raises(DeviceError, match="PYOPENCL_CTX is 'no such platform'"):
        get_device()
    monkeypatch.setenv("PYOPENCL_CTX", "0:0")
    assert get_device().cl == cl.get_platforms()[0].get_devices()[0]


class Fake:
    """The attributes of a pyopencl device or platform that discovery reads."""

    def __init__(self, name, platform=None, kind="CPU", available=True):
        self.name, self.platform, self.available = name, platform, available
        self.type = getattr(cl.device_type, kind)


class Empty(Fake):
    """A platform whose driver finds no device."""

    def __init__(self):
        super().__init__("Empty")

    def get_devices(self):
        raise cl.LogicError("DEVICE_NOT_FOUND")


@pytest.fixture
def fakes(monkeypatch):
    """Two platforms: a CPU and a small GPU on one, two GPUs on the other, one off."""
    one, two = Fake("Alpha OpenCL"), Fake("Beta")
    found = [
        Fake("Core 7", one),
        Fake("Iris", one, "GPU", available=False),
        Fake("Big 100", two, "GPU"),
        Fake("gfx906:xnack-", two, "GPU"),
    ]
    monkeypatch.setattr(discover, "find_devices", lambda: found)
    for variable in ("CLRESAMPLE_DEVICE", "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    return found


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (None, 2),  # the first GPU that is available
        (0, 0),
        ("3", 3),
        ("core", 0),
        ("big 100", 2),
        ("alpha", 0),  # a platform's name: its preferred device that is available
        ("iris", 1),
        ("alpha:core", 0),
        ("1:0", 2),
        ("beta:1", 3),
        ("GFX906:XNACK-", 3),  # a colon inside a name
    ],
)
def test_choice_among_several(fakes, choice, expected):
    assert discover.choose(choice) is fakes[expected]


@pytest.mark.parametrize("choice", ["9", "100", "delta", "alpha:9", "2:0", " ", "-1"])
def test_a_choice_that_fits_nothing_lists_what_there_is(fakes, choice):
    with pytest.raises(DeviceError, match=r"fits no device; there are: 0 = Alpha OpenCL: Core 7"):
        discover.choose(choice)


def test_cpu_when_there_is_no_gpu(fakes):
    del fakes[1:]
    assert discover.choose(None) is fakes[0]


def test_a_missing_folder_of_drivers_is_named(tmp_path):
    missing = str(tmp_path / "missing")
    answer = run_python("-m", "clresample.cli", "devices", OCL_ICD_VENDORS=missing)
    if answer.returncode == 0:
        pytest.skip("this OpenCL loader finds drivers without OCL_ICD_VENDORS")
    assert (answer.returncode, answer.stdout) == (2, "")
    assert len(answer.stderr.splitlines()) == 1
    assert f"OCL_ICD_VENDORS names a missing folder, {missing}" in answer.stderr


@pytest.mark.parametrize("platforms", [[], [Empty()]], ids=["no platform", "no device"])
def test_without_a_device_the_package_to_install_is_named(monkeypatch, platforms):
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    monkeypatch.setattr(cl, "get_platforms", lambda: platforms)
    for ask in (get_device, list_devices):
        with pytest.raises(DeviceError, match=r"no .* found: .*pip install 'pyopencl\[pocl\]'"):
            ask()


def test_table(capsys):
    assert main(["devices"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    for column in ("platform", "kind", "OpenCL", "units", "memory", "largest buffer", "fp64"):
        assert column in head
    devices = list_devices()
    assert len(rows) == len(devices)
    assert sum(row.startswith("*") for row in rows) == 1
    for row, info in zip(rows, devices):
        assert info.name in row
        assert row.endswith({True: "yes", False: "no", None: "?"}[info.fp64])


def test_table_for_a_choice_that_fits_nothing(capsys):
    assert main(["devices", "--device", "no such"]) == 2
    out, err = capsys.readouterr()
    assert len(out.splitlines()) > 1
    assert "*" not in out
    assert err.startswith("clresample devices: device is 'no such'")
    assert len(err.splitlines()) == 1


def test_a_wrong_command_is_one_line_and_status_2(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["no-such"])
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
