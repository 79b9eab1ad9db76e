"""The scripts beside the package: runtimes to test on, and the run of every kernel."""

import os
import re
import subprocess
import sys

import pytest
from helpers.checkout import ROOT

from clresample import list_devices

sys.path.insert(0, str(ROOT / "tools"))
import grind

ON_RUNTIME = ROOT / "tools" / "on_runtime.sh"


def on_runtime(*command, **environment):
    return subprocess.run(
        [ON_RUNTIME, *map(str, command)],
        env={"PATH": "/usr/bin:/bin"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_what_cannot_be_fetched_is_skipped_and_said(tmp_path):
    (tmp_path / "file").write_text("")
    answer = on_runtime("rusticl", "true", RUNTIMES=str(tmp_path / "file"))
    assert answer.returncode == 77
    assert answer.stderr.startswith("skipped: no runtime rusticl here: ")
    assert len(answer.stderr.splitlines()) == 1


def test_an_unknown_runtime_names_those_there_are(tmp_path):
    answer = on_runtime("cuda", "true", RUNTIMES=str(tmp_path))
    assert answer.returncode == 2
    assert answer.stderr.startswith("RUNTIME is cuda; there are pocl, ")


def test_a_command_runs_as_it_is_and_keeps_its_status(tmp_path):
    answer = on_runtime(
        "pocl", "bash", "-c", "echo $PYOPENCL_NO_CACHE; exit 5", RUNTIMES=str(tmp_path)
    )
    assert (answer.returncode, answer.stdout) == (5, "1\n")


def test_every_kernel_is_one_that_grind_looks_for():
    text = "".join(path.read_text() for path in (ROOT / "kernels").glob("*.cl"))
    assert len(grind.all_kernels()) == len(re.findall(r"^__kernel", text, re.MULTILINE)) > 30


@pytest.mark.parametrize("fault", grind.FAULTS)
def test_planted_faults_build(device, fault):
    """tools/grind.sh checks that Oclgrind reports them."""
    import pyopencl as cl

    cl.Kernel(cl.Program(device.context, grind.FAULTS[fault]).build(), fault)


@pytest.mark.parametrize("fault", ["missing", "hidden"])
def test_a_machine_without_a_usable_gpu_gets_its_report(tmp_path, fault):
    """Of bench/gpu_check.sh, which is tried in full on machines with a GPU."""
    report, library = tmp_path / "report.md", tmp_path / "libnvidia-opencl.so.1"
    chosen = dict.fromkeys(("CLRESAMPLE_DEVICE", "PYOPENCL_CTX", "CLRESAMPLE_ICD"), "")
    changed = {"CLRESAMPLE_ICD": str(library)}
    said = f"a driver library that is not there: {library}"
    if fault == "hidden":
        if os.environ.get("OCL_ICD_VENDORS") or any(d.kind == "GPU" for d in list_devices()):
            pytest.skip("the drivers were chosen, or a GPU is there")
        library.write_text("")
        changed = {"LD_LIBRARY_PATH": f"{os.environ.get('LD_LIBRARY_PATH', '')}:{tmp_path}"}
        said = f"no GPU is used: NVIDIA's OpenCL driver is at {library}"
    answer = subprocess.run(
        [ROOT / "bench" / "gpu_check.sh", report],
        env={**os.environ, "PYTHON": sys.executable, **chosen, **changed},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert answer.returncode == 1
    assert "No GPU could be used" in report.read_text()
    assert said in report.read_text()
    assert f"gpu_check: {report}" in answer.stderr


MAKE = """#!/bin/sh
case "$* " in
"test VENV"*) echo "=== 7 passed in 1.0s ===" ;;
*RUNTIME=intel*) echo "1 test"; {intel} ;;
*RUNTIME=rusticl*) echo "skipped: no runtime rusticl here: no network" ;;
*) echo "5 passed in 1.0s" ;;
esac
"""


@pytest.mark.parametrize(
    "intel, status, said",
    [
        ("exit 0", 0, "=== 7 passed in 1.0s ===; rusticl NOT RUN"),
        ("sleep 9", 0, "; intel NOT RUN TO THE END, no answer in time; rusticl NOT RUN"),
        (
            "echo ..F.; sleep 9",
            1,
            "; intel NOT RUN TO THE END, no answer in time, FAILED; pair NOT RUN; rusticl NOT RUN; "
            "gpu-compilers NOT RUN",
        ),
        (
            "exit 2",
            2,
            "=; intel FAILED; pair NOT RUN; rusticl NOT RUN; gpu-compilers NOT RUN",
        ),
    ],
)
def test_runtimes_that_were_not_tested_stand_in_the_last_line(tmp_path, intel, status, said):
    script = ROOT / ".ci" / "run"
    if not script.exists():
        pytest.skip("this checkout has no .ci")
    (tmp_path / "make").write_text(MAKE.format(intel=intel))
    (tmp_path / "make").chmod(0o755)
    answer = subprocess.run(
        ["bash", script],
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "BUDGET_S": "4"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == status, answer.stderr
    assert answer.stdout.splitlines()[-1].endswith(said)
