"""Devices at work: memory, kernels, and the errors that a user can meet on the way."""

import gc

import numpy as np
import pyopencl as cl
import pytest
from helpers.checkout import ROOT, run_python

from clresample import DeviceError, list_devices
from clresample.device import device as device_module, discovery as discover

POCL = "Portable Computing Language"


def pocl():
    """The first PoCL platform; the test is skipped where there is none."""
    for platform in cl.get_platforms():
        if platform.name == POCL:
            return platform
    pytest.skip("no PoCL here: its settings cannot be tried")


def two_devices():
    """The setting under which PoCL offers two devices; their names changed in version 4."""
    version = pocl().version.split("PoCL ")[1]
    return "basic pthread" if int(version.split(".")[0]) < 4 else "cpu-minimal cpu"


def error_of(status):
    """A pyopencl error of the given status, as a driver would cause it."""
    code = getattr(cl.status_code, status, -9999)
    record = cl._cl._ErrorRecord(msg=status, code=code, routine="test")
    return cl.RuntimeError(record)


# ---- memory ----


@pytest.mark.smoke
def test_arrays_there_and_back(device):
    values = np.random.default_rng(3).normal(size=(3, 8, 5))
    for given in (values, values[::2, ::-1, 1:], values.astype(">f4"), values[:0], values[0, 0, 0]):
        back = device.get(device.put(given))
        assert back.shape == np.shape(given)
        assert back.dtype == np.asarray(given).dtype.newbyteorder("=")
        np.testing.assert_array_equal(back, given)
    np.testing.assert_array_equal(
        device.get(device.put(values, np.float32)), values.astype(np.float32)
    )
    np.testing.assert_array_equal(device.get(device.zeros((2, 0, 4), np.int32)), 0)
    np.testing.assert_array_equal(device.get(device.zeros(7, np.float32)), 0)


def test_zeros_in_pieces(device, monkeypatch):
    monkeypatch.setattr(device_module, "FILL_BYTES", 64)
    np.testing.assert_array_equal(device.get(device.zeros(100, np.float32)), 0)


@pytest.mark.counts_memory
def test_memory_in_use_is_given_back(device):
    gc.collect()
    before = device.in_use
    array = device.zeros((100, 10), np.float32)
    assert device.in_use == before + 4000
    view = array[10:]
    del array
    assert device.in_use == before + 4000  # the view keeps it
    del view
    assert device.in_use == before


def test_an_impossible_size_names_both_sizes(device):
    n_bytes = device.max_alloc + 4
    with pytest.raises(DeviceError) as refusal:
        device.empty(n_bytes // 4, np.float32)
    for size in (n_bytes, device.memory, device.max_alloc):
        assert discover.format_size(size) in str(refusal.value)
    with pytest.raises(DeviceError, match="an array needs"):
        device.empty((1 << 40, 1 << 40), np.float32)


def test_a_full_device_says_so(device, monkeypatch):
    monkeypatch.setattr(device, "in_use", device.memory - 100)
    with pytest.raises(DeviceError, match="of it in use"):
        device.empty(26, np.float32)


@pytest.mark.counts_memory
@pytest.mark.parametrize("status", ["MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY"])
def test_a_refused_allocation_names_both_sizes(device, monkeypatch, status):
    monkeypatch.setattr(device_module, "_buffer_type", lambda: lost(status))
    with pytest.raises(DeviceError, match=r"an array needs 4 KiB; .* in one buffer"):
        device.empty(1024, np.float32)


def lost(status):
    """A function of pyopencl that fails with this status, whatever it is asked."""

    def refuse(*_):
        raise error_of(status)

    return refuse


@pytest.mark.parametrize("status", ["DEVICE_NOT_AVAILABLE", "OUT_OF_RESOURCES", "-9999"])
def test_a_lost_device_says_what_to_do(device, monkeypatch, status):
    monkeypatch.setattr(cl, "enqueue_marker", lost(status))
    with pytest.raises(DeviceError, match=rf"no longer answers \({status}\): start again"):
        device.finish()


def test_our_own_mistakes_stay_as_they_are(device, monkeypatch):
    monkeypatch.setattr(cl, "enqueue_marker", lost("INVALID_KERNEL_ARGS"))
    with pytest.raises(cl.Error, match="INVALID_KERNEL_ARGS"):
        device.finish()


# ---- kernels ----


def test_double_precision_is_found(device):
    if device.platform != POCL:
        pytest.skip("whether this device has double precision is not known beforehand")
    assert device.has_fp64
    assert all(info.fp64 for info in list_devices() if info.platform == POCL)


@pytest.mark.smoke
def test_macros_make_another_build(device, kernels):
    x = np.linspace(0, 1, 130).astype(np.float32)
    array, out = device.put(x), device.zeros(130, np.float32)
    for offset, expected in ((None, 2 * x), (3, 2 * x + 3), (False, 2 * x), (True, 2 * x + 1)):
        device.launcher("scale.cl", "scale", OFFSET=offset)((130,), x=array, out=out)
        np.testing.assert_allclose(device.get(out), expected, rtol=np.finfo(np.float32).eps)
    device.finish()


def test_a_failed_build_shows_the_compilers_log(device, kernels):
    with pytest.raises(DeviceError) as failure:
        device.launcher("broken.cl", "late", SIDE=7)
    message = str(failure.value)
    assert f"broken.cl does not build on {device.name}" in message
    assert "'SIDE': 7" in message
    assert "missing" in message
    assert "CLRESAMPLE_DEVICE" in message
    if device.platform == POCL:  # the lines of the file, not of what was compiled
        assert "broken.cl:1:" in message
        assert "broken.cl:3:" in message


# ---- under PoCL's settings ----

INTERLEAVED = """
import numpy as np
from clresample import get_device, list_devices
devices = [get_device(info.index) for info in list_devices() if "Portable" in info.platform]
assert len(devices) == 2 and devices[0] is not devices[1], devices
values = np.arange(1000, dtype=np.float32)
arrays = [device.put((i + 1) * values) for i, device in enumerate(devices)]
doubled = [2 * array for array in arrays]
for i, (device, array) in enumerate(zip(devices, doubled)):
    assert array.context == device.context
    assert (device.get(array) == 2 * (i + 1) * values).all()
"""


def test_two_devices_at_once():
    answer = run_python("-c", INTERLEAVED, POCL_DEVICES=two_devices())
    assert answer.returncode == 0, answer.stderr


MARK = "@pytest.mark.smoke"


def test_kernels_under_other_settings():
    """On two devices, in small groups."""
    pocl()
    environment = {"POCL_DEVICES": two_devices(), "POCL_MAX_WORK_GROUP_SIZE": "64"}
    files = [
        str(path)
        for folder in ("device", "resampling")
        for path in (ROOT / "tests" / folder).glob("test_*.py")
        if MARK in path.read_text()
    ]
    answer = run_python("-m", "pytest", "-q", "-x", "-m", "smoke", *files, **environment)
    assert answer.returncode == 0, answer.stdout


def test_values_are_there_though_blocking_copies_come_back_early(device, monkeypatch):
    """As in a driver whose blocking copies do not always wait, but whose events do."""
    copy, events = cl.enqueue_copy, []

    def early(*arguments, **options):
        if any(isinstance(one, np.ndarray) for one in arguments):
            options["is_blocking"] = False
        events.append(copy(*arguments, **options))  # an event that is dropped is waited for
        return events[-1]

    n = 1 << 22
    x, y = (device.zeros(n, np.float32) for _ in range(2))
    source = "__kernel void slow(__global float *x) { const size_t i = get_global_id(0); " + (
        "float s = 1; for (int k = 0; k < 300; ++k) s = 0.5f * s + 0.5f; x[i] = s; }"
    )
    slow = cl.Program(device.context, source).build().slow
    monkeypatch.setattr(cl, "enqueue_copy", early)
    both = [
        lambda array: device.get_all([y, array])[1],
        lambda array: device.get_all([array, y])[0],
    ]
    for read in (device.get, lambda array: _read_into(device, array), *both):
        device.copy(y, x)
        slow(device.queue, (n,), None, x.base_data)
        np.testing.assert_array_equal(read(x)[-1000:], 1)
    values = np.full(n, 3, np.float32)
    slow(device.queue, (n,), None, x.base_data)
    device.upload(values, x)
    values[:] = 5  # the host's memory is the caller's again
    assert (device.get(x) == 3).all()
    later = device.upload(values, x, wait=False)
    assert (device.get_all([x, device.zeros(0, np.float32)])[0] == 5).all()
    del later
    slow(device.queue, (n,), None, x.base_data)
    last = cl.enqueue_marker(device.queue)
    device.finish()
    if "rusticl" not in device.platform:  # it marks what is done as done in no order
        assert last.command_execution_status == cl.command_execution_status.COMPLETE


def _read_into(device, array):
    values = np.zeros(array.shape, array.dtype)
    device.download(array, values)
    return values


def test_parts_of_an_array_are_read_and_written_where_they_lie(device):
    whole = np.arange(20, dtype=np.float32)
    x = device.put(whole)
    parts = [(1, 3), (3, 3), (3, 5), (18, 20)]
    found = device.get_parts(x, parts)
    assert found.shape == (20,) and device_module.joined(parts) == [(1, 5), (18, 20)]
    at = [1, 2, 3, 4, 18, 19]
    np.testing.assert_array_equal(found[at], whole[at])
    assert device.get_parts(x, []).shape == (20,)
    device.put_parts({4: np.array([-1.0, -2.0]), 9: np.zeros(0), 18: np.array([5.0])}, x)
    whole[[4, 5, 18]] = -1, -2, 5
    np.testing.assert_array_equal(device.get(x), whole)
