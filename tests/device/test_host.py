"""Cores and memory of this process, as its control groups limit them."""

import pytest

from clresample.device import host

MIB = 2**20


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A function that writes files and makes them those of a machine of 8 cores, 4000 MiB free."""

    def made(own, files):
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        (tmp_path / "own").write_text(own)
        memory = "MemTotal:       16384000 kB\nMemAvailable:    4096000 kB\nHugePages_Total:  0\n"
        (tmp_path / "meminfo").write_text(memory)
        monkeypatch.setattr(host, "CGROUPS", tmp_path)
        monkeypatch.setattr(host, "OWN_GROUPS", tmp_path / "own")
        monkeypatch.setattr(host, "MEMORY_INFO", tmp_path / "meminfo")
        monkeypatch.setattr(host.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)

    return made


@pytest.mark.parametrize(
    "own, files, n_cores, free",
    [
        ("", {}, 8, 4000 * MIB),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "250000 100000\n"}, 3, None),
        ("0::/\n", {"cpu.max": "50000 100000\n"}, 1, None),
        (
            "0::/\n",
            {"cpu.max": "nonsense\n", "memory.max": "max\n", "memory.current": "1"},
            8,
            None,
        ),
        (
            "2:cpu,cpuacct:/\n1:memory:/job\n",
            {
                "cpu/cpu.cfs_quota_us": "400000",
                "cpu/cpu.cfs_period_us": "100000",
                "memory/job/memory.limit_in_bytes": str(1000 * MIB),
                "memory/job/memory.usage_in_bytes": str(700 * MIB),
                "memory/job/memory.stat": f"cache 1\ninactive_file {200 * MIB}\n",
            },
            4,
            500 * MIB,
        ),
        (
            "0::/\n",
            {"memory.max": str(100 * MIB), "memory.current": str(300 * MIB), "memory.stat": ""},
            8,
            0,
        ),
        ("2:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8, None),
    ],
)
def test_what_a_process_may_use(machine, own, files, n_cores, free):
    machine(own, files)
    assert host.n_host_cores() == n_cores
    assert host.free_memory() == (4000 * MIB if free is None else free)


def test_other_systems_have_a_number_too(monkeypatch, tmp_path):
    for name in ("CGROUPS", "OWN_GROUPS", "MEMORY_INFO"):
        monkeypatch.setattr(host, name, tmp_path / "none")
    assert host.free_memory() > 0 and host.n_host_cores() >= 1
