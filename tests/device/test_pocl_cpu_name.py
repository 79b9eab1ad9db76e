"""PoCL 3.0 on processors that its compiler does not know."""

import ctypes
import platform

import pytest

from clresample.device import pocl_cpu_name

pytestmark = pytest.mark.skipif(
    platform.system() != "Linux" or platform.machine() != "x86_64",
    reason="PoCL's record is looked at on x86 under Linux only",
)
AVX2 = "sse2 avx avx2 fma bmi1 bmi2 f16c movbe"
AVX512 = f"{AVX2} avx512f avx512bw avx512cd avx512dq avx512vl"


class Record:
    """A device's record as PoCL's is laid out: pointers to texts, among other words."""

    version = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic"
    driver_version = "3.0-rc2"

    def __init__(self, *texts, at=80):
        self.held = [ctypes.create_string_buffer(text.encode(), 64) for text in texts]
        self.words = (ctypes.c_void_p * 256)()
        for k in range(256):
            self.words[k] = 7 * k  # words that are no addresses
        for k, text in enumerate(self.held):
            self.words[at + k] = ctypes.addressof(text)
        self.int_ptr = ctypes.addressof(self.words)

    def text(self, k):
        return ctypes.string_at(self.words[k]).decode()


@pytest.fixture
def flags(monkeypatch):
    def of(text):
        monkeypatch.setattr(pocl_cpu_name, "_flags", lambda: set(text.split()))

    of(AVX512)
    return of


@pytest.mark.parametrize(
    ("instructions", "name"), [(AVX512, "skylake-avx512"), (AVX2, "haswell"), ("sse2 avx", None)]
)
def test_the_name_follows_the_instructions(flags, instructions, name):
    flags(instructions)
    record = Record(pocl_cpu_name.TRIPLE, pocl_cpu_name.UNKNOWN)
    assert pocl_cpu_name.set_pocl_cpu_name(record) == name
    assert record.text(81) == (name or pocl_cpu_name.UNKNOWN)
    assert record.text(80) == pocl_cpu_name.TRIPLE


@pytest.mark.parametrize(
    "texts",
    [
        (pocl_cpu_name.TRIPLE, "znver3"),
        ("aarch64-unknown-linux-gnu", pocl_cpu_name.UNKNOWN),
        (pocl_cpu_name.TRIPLE, pocl_cpu_name.UNKNOWN, pocl_cpu_name.TRIPLE, pocl_cpu_name.UNKNOWN),
        (),
    ],
)
def test_a_record_of_another_make_is_left_alone(flags, texts):
    record = Record(*texts)
    before = list(record.words)
    assert pocl_cpu_name.set_pocl_cpu_name(record) is None
    assert list(record.words) == before


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("version", "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3"),
        ("driver_version", "3.1+debian"),
    ],
)
def test_other_processors_and_releases_are_left_alone(flags, attribute, value):
    record = Record(pocl_cpu_name.TRIPLE, pocl_cpu_name.UNKNOWN)
    setattr(record, attribute, value)
    assert pocl_cpu_name.set_pocl_cpu_name(record) is None
    assert record.text(81) == pocl_cpu_name.UNKNOWN


def test_memory_that_is_not_there_is_not_read(flags):
    record = Record()
    record.int_ptr = 4096
    assert pocl_cpu_name.set_pocl_cpu_name(record) is None
