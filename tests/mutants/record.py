"""A plugin for pytest that notes which tests run which lines and kernels of the package."""

from __future__ import annotations

import os
import sys
import threading

import pytest


def _seconds():
    """Processor time [s] of this process and those it has waited for: on a busy machine no more."""
    return sum(os.times()[:4])


class Recorder:
    """For each test that passes: its seconds, the lines of Python and the kernels that it ran.

    folder: of the package; lines of other files are not recorded
    """

    def __init__(self, folder):
        self.folder = f"{folder}/"
        self.tests = {}  # test: {"seconds": ..., "ran": [[file, line], ...]}
        self._ran, self._passed = set(), set()

    def _trace(self, frame, _event, _argument):
        name = frame.f_code.co_filename
        if not name.startswith(self.folder):
            return None
        add = self._ran.add

        def line(frame, _event, _argument):
            add((name, frame.f_lineno))
            return line

        return line

    def pytest_collection_finish(self, session):
        """Lines run when modules are imported belong to no test: the tracing begins after it."""
        from clresample import Device
        from clresample.device.program import Launcher

        launcher, call, add = Device.launcher, Launcher.__call__, self._ran.add

        def made(device, file, name, **options):
            one = launcher(device, file, name, **options)
            one.noted = f"kernels/{file}", name
            return one

        def called(self, *arguments, **given):
            add(self.noted)
            return call(self, *arguments, **given)

        Device.launcher, Launcher.__call__ = made, called
        threading.settrace(self._trace)
        sys.settrace(self._trace)

    def pytest_runtest_setup(self, item):
        self._ran.clear()
        self._began = _seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        """Fixtures of a session do not count in the time of the first test that uses them."""
        began = _seconds()
        value = yield
        if fixturedef.scope == "session":
            self._began += _seconds() - began
        return value

    def pytest_runtest_logreport(self, report):
        if report.when == "call" and report.passed:
            self._passed.add(report.nodeid)
        if report.when == "teardown" and report.nodeid in self._passed:
            self.tests[report.nodeid] = {
                "seconds": _seconds() - self._began,
                "ran": sorted(self._ran),
            }
