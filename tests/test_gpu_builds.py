"""tools/gpu_builds and tools/gpu_model: what compilers say is read right, and faults are found."""

import subprocess
import sys
from dataclasses import replace

import pytest
from helpers.checkout import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import gpu_model
from gpu_builds.__main__ import Row, line, main, rows_of, worst
from gpu_builds.captured import Build, kernel_names
from gpu_builds.compilers import (
    Amd,
    BuildError,
    Intel,
    MissingCompilerError,
    Nvidia,
    Toolbox,
    compiler_for,
)
from gpu_builds.faults import KEPT_KERNELS, faults_of, is_fault
from gpu_builds.readings import Resources, read_amd, read_intel, read_ptxas, warnings_of

PTXAS = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'one' for 'sm_90'
ptxas info    : Function properties for one
    96 bytes stack frame, 80 bytes spill stores, 92 bytes spill loads
ptxas info    : Used 255 registers, used 1 barriers, 16896 bytes smem
ptxas info    : Compiling entry function 'two' for 'sm_90'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 13 registers
"""

AMD = """
one:
; Occupancy: 3
two:
; Occupancy: 8
	.amdgpu_metadata
---
amdhsa.kernels:
  - .agpr_count:     0
    .args:
      - .offset:         0
        .name:           x
    .group_segment_fixed_size: 16896
    .name:           one
    .private_segment_fixed_size: 104
    .vgpr_count:     256
    .vgpr_spill_count: 23
  - .args:
    .group_segment_fixed_size: 0
    .name:           two
    .private_segment_fixed_size: 0
    .vgpr_count:     13
    .vgpr_spill_count: 0
"""

INTEL = """kernels:
  - name:            one
    execution_env:
      grf_count:       128
      simd_size:       32
      slm_size:        16896
    per_thread_memory_buffers:
      - type:            scratch
        usage:           single_space
        size:            16384
  - name:            two
    execution_env:
      grf_count:       128
      simd_size:       16
kernels_misc_info:
  - name:            one
"""
OCLOC = "warning: kernel one  compiled SIMD32 allocated 128 regs and spilled around 194\n"


def test_words_of_ptxas():
    assert read_ptxas(PTXAS) == {
        "one": Resources(registers=255, spill=80, stack=96, local=16896),
        "two": Resources(registers=13, spill=0, stack=0, local=0),
    }


def test_assembly_for_amd():
    assert read_amd(AMD) == {
        "one": Resources(registers=256, spill=92, stack=104, local=16896, waves=3),
        "two": Resources(registers=13, spill=0, stack=0, local=0, waves=8),
    }


def test_binaries_of_intel():
    assert read_intel(INTEL, OCLOC) == {
        "one": Resources(registers=128, spill=388, stack=512, local=16896, lanes=32),
        "two": Resources(registers=128, spill=0, stack=0, local=0, lanes=16),
    }


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (read_ptxas, PTXAS.replace("spill stores", "stores that spill")),
        (read_amd, AMD.replace(".vgpr_spill_count", ".vgprs_spilled")),
        (lambda text: read_intel(text, ""), INTEL.replace("simd_size", "lanes")),
    ],
)
def test_words_in_another_form_are_an_error_and_no_zero(read, words):
    with pytest.raises(ValueError, match="its format has changed"):
        read(words)


def test_warnings_are_those_of_the_text():
    said = "x.cl:3:1: warning: unused variable 'a'\nwarning: linking module 'x': Linking two\n"
    assert warnings_of(said + OCLOC) == ["unused variable 'a'"]


@pytest.mark.parametrize(
    ("registers", "local", "size", "warps"),
    [
        (164, 14848, 64, 12),  # by registers
        (252, 18944, 64, 8),
        (13, 0, 64, 64),
        (24, 0, 16, 32),  # 32 groups of half a warp
        (40, 60000, 64, 6),  # by local memory
    ],
)
def test_warps_that_fit_on_a_multiprocessor(registers, local, size, warps):
    one = Resources(registers=registers, spill=0, stack=0, local=local)
    assert Nvidia.waves(Nvidia, one, size) == (warps, 64)


@pytest.mark.parametrize(
    ("name", "kind"), [("sm_90", Nvidia), ("gfx90a", Amd), ("gfx1100", Amd), ("pvc", Intel)]
)
def test_a_compiler_that_is_not_there_is_named_with_its_package(tmp_path, monkeypatch, name, kind):
    monkeypatch.setenv("PATH", str(tmp_path))
    tools = Toolbox(tmp_path, [tmp_path])
    tools.roots, tools.packages = [tmp_path], [tmp_path]
    with pytest.raises(MissingCompilerError, match="which the package .* has"):
        compiler_for(name, tools)


def test_with_no_compiler_at_all_it_is_skipped_aloud(monkeypatch, capsys):
    def missing(name, tools):
        raise MissingCompilerError("no clang-19, which the package clang-19 has")

    monkeypatch.setattr("gpu_builds.__main__.compiler_for", missing)
    assert main(["sm_90"]) == 77
    said = capsys.readouterr()
    assert said.out.startswith("gpu-builds: sm_90 left out: no clang-19")
    assert said.err == "skipped: gpu-builds: no compiler for any of its targets is here\n"


def test_a_target_of_no_vendor_is_refused(tmp_path):
    with pytest.raises(ValueError, match="target is 'SM90'; it must be"):
        compiler_for("SM90", Toolbox())


GOOD = Resources(registers=40, spill=0, stack=0, local=8192)


def row(resources, **given):
    head = {"target": "sm_90", "file": "scene.cl", "kernel": "compose", "dtype": "float32"}
    return Row(**head | {"variant": "", "group": (32, 2, 1)} | given, resources=resources)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, []),
        ({"spill": 4, "stack": 4}, ["spills 4"]),
        ({"stack": 8}, ["stack 8"]),
        ({"local": 40000}, ["local 40000 > 32768"]),
    ],
)
def test_faults_of_a_kernel(change, words):
    found = row(replace(GOOD, **change))
    assert faults_of(found) == words
    assert all(map(is_fault, found.faults))
    assert line(found).endswith("; ".join(words))


@pytest.mark.parametrize("kept", KEPT_KERNELS, ids=lambda k: f"{k.target} {k.kernel}")
def test_what_is_kept_is_no_fault_until_it_grows(kept):
    names = {"file": kept.file, "kernel": kept.kernel, "dtype": kept.dtype}
    names["target"] = kept.target or "gfx90a"
    assert kept.kernel in kernel_names((ROOT / "kernels" / kept.file).read_text())
    one = replace(GOOD, spill=kept.spill, stack=kept.stack)
    assert not any(map(is_fault, faults_of(row(one, **names))))
    assert any(map(is_fault, faults_of(row(replace(one, stack=kept.stack + 8), **names))))
    if kept.target:
        assert any(map(is_fault, faults_of(row(one, **names | {"target": "sm_90"}))))


def test_a_build_that_fails_is_a_fault_with_the_compilers_words(tmp_path):
    class Compiler:
        name = "sm_90"

        def compile(self, source, stem):
            raise BuildError("x.cl:1:1: error: no")

    build = Build("x.cl", "float32", "text", {}, {"one": {None}})
    (failed,) = rows_of(build, Compiler(), tmp_path / "x")
    assert failed.faults == ["does not build"]
    assert "x.cl:1:1: error: no" in line(failed)
    spilling = row(replace(GOOD, spill=8), file="x.cl", kernel="*")
    assert worst([spilling, failed]) == [failed]


def test_vendors_sizes_are_in_their_builds():
    build = Build("boxed.cl", "float32", "", {"VW": 4}, {"multiply_boxes": {(16, 4, 1)}})
    assert "#define MR 2\n" in build.for_vendor("Intel").text
    assert "#define MR 8\n" in build.for_vendor("AMD").text
    assert build.for_vendor("Intel").groups == {"multiply_boxes": {(16, 4, 1)}}


COUNTS = gpu_model.Counts(
    n_scenes=2,
    n_rounds=10,
    n_waits=20,
    host_s=0.2,
    kernels={"contract_group": (100, 4e12, 1e6), "residual": (10, 0, 1e12), "tie": (10, 0, 10)},
)


def test_each_kernel_takes_the_longest_of_its_parts():
    card = gpu_model.Card("a card", "sm_90", 1e13, 1e12, 0.4)
    found = gpu_model.predict(COUNTS, card, 4)
    assert found.bounds == {
        "contract_group": "arithmetic",
        "residual": "bandwidth",
        "tie": "latency",
    }
    gap = gpu_model.GAP_S
    assert found.kernels["contract_group"] == pytest.approx(2 + 100 * gap)
    assert found.kernels["residual"] == pytest.approx(2 / gpu_model.BANDWIDTH_SHARE + 10 * gap)
    assert found.kernels["tie"] == pytest.approx(10 * (gap + gpu_model.FLOOR_S))
    assert found.host_s == pytest.approx(0.4)
    assert found.waits_s == pytest.approx(20 * gpu_model.WAIT_S)
    assert found.limit == "device"


def test_counts_are_written_and_read(tmp_path):
    import json
    from dataclasses import asdict

    path = tmp_path / "counts.json"
    path.write_text(json.dumps(asdict(COUNTS)))
    command = [sys.executable, ROOT / "tools" / "gpu_model.py", "--json", path, "--groups", "2"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "Counted of 2 scenes: 10 rounds" in told
    assert "| H100 SXM | 2 |" in told
