"""Runs of pytest in forked children: Python, NumPy, SciPy and astropy are loaded once for all.

Started in a copy of the checkout; reads a request a line, JSON {"arguments": [...], "seconds": s,
"record": file or null}, and answers each with a line {"status": s, "failed": test or null}. A child
that takes longer than `seconds` of processor time, or four times that by the clock, is killed.
Children start without an OpenCL device: those do not live through a fork.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import signal
import sys
import time
from pathlib import Path

LOADED = (
    "numpy", "scipy.optimize", "scipy.special", "scipy.ndimage", "scipy.sparse.linalg",
    "scipy.interpolate", "scipy.stats", "astropy.io.fits", "astropy.table", "astropy.wcs",
    "astropy.coordinates", "hypothesis", "pytest", "_pytest.assertion.rewrite", "pyopencl",
    "pyopencl.array",
)  # fmt: skip


def main():
    """Answer requests until there are none."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    for name in LOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    sys.path[0] = os.getcwd()  # and not this file's folder
    for line in sys.stdin:
        request = json.loads(line)
        told = Path("told.json")
        told.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            os.setsid()
            code = 99
            try:
                code = run(request, told)
            finally:
                os._exit(code)
        status = wait(child, request["seconds"])
        said = json.loads(told.read_text()) if told.exists() else {}
        print(json.dumps({"status": status, **said}), file=answers)


def wait(child, seconds):
    """The child's status, or -1 where it had to be killed."""
    end = time.monotonic() + 4 * seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.02)
    else:
        status = None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # and what it has started
    if status is None:
        os.waitpid(child, 0)
        return -1
    return os.waitstatus_to_exitcode(status)


def run(request, told):
    """In the child: pytest's status."""
    import pytest

    seconds = int(request["seconds"])
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    plugins = [First(told)]
    if request.get("record"):
        from tests.mutants.record import Recorder

        plugins.append(Recorder(Path.cwd() / "clresample"))
    else:
        sys.dont_write_bytecode = True  # of a source that changes twice a second
    status = pytest.main(["-q", "-p", "no:cacheprovider", *request["arguments"]], plugins=plugins)
    if request.get("record"):
        sys.settrace(None)
        Path(request["record"]).write_text(json.dumps(plugins[-1].tests))
    return int(status)


class First:
    """Writes down the first failure."""

    def __init__(self, told):
        self.told = told

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.told.exists():
            why = str(report.longrepr)
            why = f"{report.nodeid}: {[t for t in why.splitlines() if t.startswith('E ')][:1]}"
            self.told.write_text(json.dumps({"failed": why, "built": "does not build" not in why}))


if __name__ == "__main__":
    main()
