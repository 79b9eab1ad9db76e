"""Driver libraries that the loader does not see, and the one that CLRESAMPLE_ICD names."""

import ctypes.util
import os
import shlex
from pathlib import Path

import pyopencl as cl
import pytest
from helpers.checkout import run_python

from clresample import DeviceError, list_devices
from clresample.device import discovery, drivers
from clresample.device.discovery import driver_hints

NVIDIA = "libnvidia-opencl.so.1"
PLATFORMS = "from clresample import list_devices; print(*[d.platform for d in list_devices()])"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of no GPU driver but those that a test puts into the folder."""
    monkeypatch.setattr(drivers, "FOLDERS", ())
    monkeypatch.setattr(drivers.subprocess, "run", lambda *_, **__: type("R", (), {"stdout": ""}))
    monkeypatch.setenv("LD_LIBRARY_PATH", f"relative:{tmp_path}")
    monkeypatch.delenv("CLRESAMPLE_ICD", raising=False)
    return tmp_path


class Gpu:
    """The attributes of a pyopencl device of a real GPU's driver that are read."""

    type = cl.device_type.GPU
    name = "H100"

    def __init__(self, vendor):
        names = {"name": f"{vendor} CUDA", "vendor": f"{vendor} Corp", "int_ptr": 0}
        self.platform = type("Platform", (), names)


@pytest.mark.parametrize("library", drivers.LIBRARIES)
def test_a_driver_without_its_icd_file_is_named_with_its_cure(machine, library):
    assert driver_hints() == []
    (machine / library).write_text("")
    (hint,) = driver_hints()
    assert hint.startswith(drivers.LIBRARIES[library])
    assert hint.endswith(f": export CLRESAMPLE_ICD={machine / library}")


def test_nothing_is_said_of_a_driver_that_brings_its_gpu(machine, monkeypatch):
    (machine / NVIDIA).write_text("")
    monkeypatch.setattr(discovery, "find_devices", lambda: [Gpu("NVIDIA")])
    assert driver_hints() == []
    monkeypatch.setattr(discovery, "find_devices", lambda: [Gpu("Intel")])
    assert len(driver_hints()) == 1


def test_a_driver_that_the_loader_reads_is_not_said_to_be_hidden(machine, monkeypatch):
    (machine / NVIDIA).write_text("no library")
    (machine / "nvidia.icd").write_text(f"{NVIDIA}\n")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(machine))
    (hint,) = driver_hints()
    assert hint.startswith(f"NVIDIA's OpenCL driver, {machine / NVIDIA}, cannot be loaded: ")
    assert "export" not in hint


def test_drivers_that_the_system_lists_are_found(machine, monkeypatch):
    (machine / NVIDIA).write_text("")
    monkeypatch.delenv("LD_LIBRARY_PATH")
    listing = f"\t{NVIDIA} (libc6,x86-64) => {machine / NVIDIA}\n\tlibc.so.6 => /lib/libc.so.6\n"
    answer = type("R", (), {"stdout": listing})
    monkeypatch.setattr(drivers.subprocess, "run", lambda *_, **__: answer)
    assert drivers.undetected_drivers([]) == [("NVIDIA", machine / NVIDIA)]


def test_where_there_is_no_device_the_error_names_the_driver(machine, monkeypatch):
    (machine / NVIDIA).write_text("")
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    monkeypatch.setattr(cl, "get_platforms", lambda: [])
    with pytest.raises(DeviceError, match=rf"; NVIDIA's OpenCL driver is at .*: export .*{NVIDIA}"):
        discovery.find_devices()


def test_the_command_gives_the_cure(tmp_path):
    (tmp_path / "libamdocl64.so").write_text("")
    answer = run_python("-m", "clresample.cli", "devices", LD_LIBRARY_PATH=_after(tmp_path))
    assert answer.returncode == 0, answer.stderr
    assert f"AMD's OpenCL driver is at {tmp_path}/libamdocl64.so" in answer.stderr


def test_a_cpu_is_not_used_silently_beside_a_hidden_gpu(tmp_path):
    if os.environ.get("OCL_ICD_VENDORS") or any(d.kind == "GPU" for d in list_devices()):
        pytest.skip("the drivers were chosen, or a GPU is there")
    (tmp_path / "libamdocl64.so").write_text("")
    code = "from clresample import get_device; get_device(); get_device(); get_device(0)"
    given = dict.fromkeys(("CLRESAMPLE_DEVICE", "PYOPENCL_CTX", "CLRESAMPLE_ICD"), "")
    given["LD_LIBRARY_PATH"] = _after(tmp_path)
    answer = run_python("-c", code, **given)
    cure = f"where the OpenCL loader does not look: export CLRESAMPLE_ICD={tmp_path}/libamdocl64.so"
    assert answer.stderr.count("no GPU is used: AMD's OpenCL driver is at") == 1
    assert cure in answer.stderr
    chosen = run_python("-c", code, **given | {"CLRESAMPLE_DEVICE": "0"})
    assert not chosen.stderr


def test_a_library_that_is_no_driver_is_named(tmp_path):
    library = tmp_path / NVIDIA
    library.write_text("no library")
    answer = run_python("-m", "clresample.cli", "devices", CLRESAMPLE_ICD=str(library))
    assert answer.returncode == 0, answer.stderr  # the other devices are there
    assert f"CLRESAMPLE_ICD={library} cannot be loaded:" in answer.stderr
    answer = run_python("-m", "clresample.cli", "devices", CLRESAMPLE_ICD=f"{library}.2")
    assert answer.returncode == 2
    assert answer.stderr.endswith(f"a driver library that is not there: {library}.2\n")


def test_a_named_driver_is_seen_beside_the_others(tmp_path):
    """PoCL, hidden by an empty folder of drivers, is found through CLRESAMPLE_ICD."""
    folders = [Path(cl.__file__).parent / ".libs", Path(drivers.VENDORS)]
    pocl = [p for f in folders for p in f.glob("libpocl*")] or [
        Path(p.read_text().strip()) for f in folders for p in f.glob("pocl*.icd")
    ]
    if not pocl or os.environ.get("OCL_ICD_VENDORS"):
        pytest.skip("no PoCL whose library is known")
    before = run_python("-c", PLATFORMS).stdout.split("Portable")
    after = run_python("-c", PLATFORMS, CLRESAMPLE_ICD=str(pocl[0]))
    assert after.returncode == 0, after.stderr
    assert len(after.stdout.split("Portable")) == len(before) + 1
    assert "CLRESAMPLE_ICD" not in after.stderr


def test_what_the_loader_reads_anyway_is_kept(tmp_path, monkeypatch):
    (tmp_path / "one.icd").write_text("libone.so\n")
    (tmp_path / "libone.so").write_text("")
    for vendors, expected in (
        (tmp_path, {"one.icd": str(tmp_path / "libone.so")}),
        (tmp_path / "one.icd", {"one.icd": str(tmp_path / "libone.so")}),
        (tmp_path / "libone.so", {"given.icd": str(tmp_path / "libone.so")}),
    ):
        monkeypatch.setenv("OCL_ICD_VENDORS", str(vendors))
        assert drivers._known() == expected


@pytest.mark.parametrize("is_listed", [False, True])
def test_conda_s_loader_is_told_of_the_systems_drivers(machine, monkeypatch, is_listed):
    """Conda's loader reads its own folder of drivers, and the system's by a package more."""
    (machine / NVIDIA).write_text("")
    conda, system = machine / "conda", machine / "vendors"
    for folder in (conda / "conda-meta", conda / "etc/OpenCL/vendors", system):
        folder.mkdir(parents=True)
    (conda / "etc/OpenCL/vendors/pocl.icd").write_text("libpocl.so")
    if is_listed:
        (system / "nvidia.icd").write_text(NVIDIA)
    monkeypatch.setattr(drivers, "VENDORS", str(system))
    monkeypatch.setattr(drivers.sys, "prefix", str(conda))
    monkeypatch.setenv("CONDA_PREFIX", str(conda))
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    assert drivers.conda_prefix() is None  # the environment's pyopencl is pip's
    (conda / "conda-meta/pyopencl-2025.1-0.json").write_text("{}")
    assert drivers._known() == {"pocl.icd": "libpocl.so"}
    (hint,) = driver_hints()
    cure = drivers.CONDA_CURE if is_listed else f"export CLRESAMPLE_ICD={machine / NVIDIA}"
    assert hint.endswith(f": {cure}")
    monkeypatch.setattr(drivers.sys, "prefix", "/usr")  # another Python than the environment's
    assert drivers.conda_prefix() is None


def test_the_cure_is_one_line_for_a_shell():
    assert shlex.split(drivers.icd_export_line(Path("/a/b.so"))) == [
        "export",
        "CLRESAMPLE_ICD=/a/b.so",
    ]


def _after(folder):
    return f"{os.environ.get('LD_LIBRARY_PATH', '')}:{folder}"


def test_a_library_that_brings_no_device_is_said():
    library = ctypes.util.find_library("m")
    if not library:
        pytest.skip("no C library is known by name")
    code = "from clresample import get_device; get_device(); get_device(); print('fine')"
    answer = run_python("-c", code, CLRESAMPLE_ICD=library)
    assert answer.stdout == "fine\n"
    assert answer.stderr.count(f"CLRESAMPLE_ICD={library} is no OpenCL driver") == 1
    answer = run_python("-m", "clresample.cli", "devices", CLRESAMPLE_ICD=library)
    assert f"note: CLRESAMPLE_ICD={library} is no OpenCL driver\n" in answer.stderr


def test_a_driver_without_a_device_is_said(monkeypatch):
    monkeypatch.setattr(drivers.ctypes, "CDLL", lambda _: None)
    monkeypatch.setattr(drivers, "_platforms_of", lambda _: {12, 34})
    assert drivers.driver_fault("libx.so", {34}) is None
    assert drivers.driver_fault("libx.so", {56}) == "is an OpenCL driver that finds no device here"


def test_temporary_folders_of_killed_processes_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(drivers.tempfile, "tempdir", str(tmp_path))
    code = (
        "import os, sys, tempfile; from clresample.device import drivers\n"
        "tempfile.tempdir = sys.argv[1]\n"
        "print(drivers.temporary_folder('icd')); drivers.temporary_folder('cache')\n"
        "sys.stdout.flush(); os.kill(os.getpid(), 9)"
    )
    left = Path(run_python("-c", code, str(tmp_path)).stdout.strip())
    assert left.is_dir()
    (left / "x.icd").write_text("")
    other = tmp_path / left.name.replace("clresample-icd-", "clresample-icd-elsewhere")
    other.mkdir()
    (tmp_path / left.name.replace("-icd-", "-icd-x-")).mkdir()
    first, second = drivers.temporary_folder("icd"), drivers.temporary_folder("icd")
    assert first.is_dir() and second.is_dir() and first != second  # this process is alive
    assert not left.exists() and other.exists()
    assert len(list(tmp_path.glob("clresample-cache-*"))) == 1  # another kind
