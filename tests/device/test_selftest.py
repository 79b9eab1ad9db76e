"""A device that computes wrongly is named and not used; what has passed is remembered."""

import json
import warnings

import numpy as np
import pytest
from helpers.checkout import run_python

from clresample import Device, DeviceError, get_device
from clresample.device import device as device_module, discovery, program, selftest
from clresample.device.device_cache import DeviceCache, DeviceWarning


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """A cache folder of the test's own, and devices that this process has not tried yet."""
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path / "cache"))
    tried = device_module._fault
    tried.cache_clear()
    yield tmp_path / "cache"
    tried.cache_clear()


@pytest.fixture
def wrong(monkeypatch):
    """Transfer functions are wrong: what a wrong driver, or kernel, could do."""
    source_of = program.source_of

    def other(file, dtype, defines):
        return source_of(file, dtype, defines).replace("(cc) - (ss)", "(cc) + (ss)")

    monkeypatch.setattr(program, "source_of", other)


def test_the_render_is_numpys(device):
    found, truth = selftest.render(device), selftest.reference()
    error = np.linalg.norm(found - truth) / np.linalg.norm(truth)
    assert error < selftest.ALLOWED / 20


def test_what_has_passed_is_not_tried_again(device, empty_cache, monkeypatch):
    assert selftest.self_test_fault(device, DeviceCache(device.cl)) is None
    (path,) = empty_cache.glob("devices/*.json")
    assert json.loads(path.read_text())["device"] == device.name
    monkeypatch.setattr(selftest, "render", None)  # would fail if it were called again
    assert selftest.self_test_fault(device, DeviceCache(device.cl)) is None


@pytest.mark.parametrize("error", [1e-4, np.nan])
def test_a_wrong_render_is_a_fault(device, empty_cache, monkeypatch, error):
    monkeypatch.setattr(selftest, "render", lambda _: selftest.reference() * (1 + error))
    message = selftest.self_test_fault(device, DeviceCache(device.cl))
    assert message.startswith(f"{device.name} ({device.platform}) fails its self-test")
    assert not empty_cache.exists()


def test_a_device_that_fails_is_not_used(device, empty_cache, wrong, monkeypatch):
    monkeypatch.setattr(device_module, "_open", Device)  # one that has built nothing
    with pytest.raises(DeviceError, match=r"fails its self-test: .* choose another device"):
        get_device(next(i.index for i in discovery.list_devices() if i.name == device.name))


def test_another_is_taken_where_none_was_named(device, empty_cache, monkeypatch):
    monkeypatch.delenv("CLRESAMPLE_DEVICE", raising=False)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)

    class Bad:
        name = "Bad"

    monkeypatch.setattr(device_module, "choose", lambda _: Bad)
    monkeypatch.setattr(device_module, "find_devices", list)
    monkeypatch.setattr(device_module, "by_preference", lambda _: [Bad, device.cl])
    faults = {Bad: "Bad fails its self-test", device.cl: None}
    monkeypatch.setattr(device_module, "_fault", faults.get)
    with pytest.warns(DeviceWarning, match=f"Bad fails its self-test; .*{device.name[:4]}"):
        assert get_device().cl == device.cl
    with pytest.raises(DeviceError, match="Bad fails its self-test: update the driver"):
        get_device("bad")


def test_a_kernel_that_does_not_build_is_a_fault(device, empty_cache, monkeypatch):
    monkeypatch.setattr(device_module, "_open", Device)

    def broken(*_):
        raise DeviceError("contract.cl does not build")

    monkeypatch.setattr(selftest, "render", broken)
    assert "self-test: contract.cl does not build" in device_module._fault(device.cl)


@pytest.mark.parametrize("text", ["[", "7", "\x00"])
def test_a_broken_file_is_ignored_in_one_line(device, empty_cache, text):
    remembered = DeviceCache(device.cl)
    remembered.write("a", 1)
    assert remembered.read("a") == 1
    remembered.path.write_text(text)
    remembered = DeviceCache(device.cl)
    with pytest.warns(DeviceWarning, match=r"\.json is ignored: ") as caught:
        assert remembered.read("a") is None
        assert remembered.read("a") is None
    (warning,) = caught
    assert "\n" not in str(warning.message)
    remembered.write("b", 2)
    again = DeviceCache(device.cl)
    assert (again.read("a"), again.read("b")) == (None, 2)


def test_a_folder_that_cannot_be_written_is_no_fault(device, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path / "file"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeviceWarning)
        assert selftest.self_test_fault(device, DeviceCache(device.cl)) is None


def test_the_command_shows_such_a_warning_in_one_line(tmp_path):
    first = run_python("-m", "clresample.cli", "devices", CLRESAMPLE_CACHE=str(tmp_path))
    assert (first.returncode, first.stderr) == (0, "")
    for path in tmp_path.glob("devices/*.json"):
        path.write_text("[")
    again = run_python("-m", "clresample.cli", "devices", CLRESAMPLE_CACHE=str(tmp_path))
    assert again.returncode == 0
    lines = again.stderr.splitlines()
    assert lines and all(".json is ignored: " in line for line in lines), again.stderr
