"""Reports that kernels are being compiled: a wait of seconds that happens once."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress

from ..drawing.bar import is_watched, passing_bar
from .host import n_host_cores

# [s] Processor time of a build: 0.02 from PoCL's or pyopencl's cache, 0.08 and more from source.
MAX_CACHED_S = 0.04
PLATFORM = "Portable Computing Language"


class CompilationNotice:
    """Prints one line at the first build that no cache had, and a count of the later ones.

    Only in terminals and notebooks. The count is erased when nothing is being compiled.

    device: name of the device
    """

    def __init__(self, device):
        self.device, self._lock = device, threading.Lock()
        self._n_built = self._n_waiting = 0
        self._began, self._bar = time.monotonic(), None

    def build(self, build):
        """Returns `build()`, and counts it if it took longer than a cached build."""
        with self.shown():
            began = time.thread_time()
            built = build()
            if time.thread_time() - began > MAX_CACHED_S:
                self._count()
        return built

    @contextmanager
    def shown(self):
        """Draws the count during a build or a first launch; threads share it."""
        with self._lock:
            self._n_waiting += 1
            if self._n_built and self._bar is None and is_watched():
                title = f"compiling kernels for {self.device}"
                self._bar = passing_bar(title, "programs", self._n_built, self._began)
        try:
            yield
        finally:
            with self._lock:
                self._n_waiting -= 1
                if self._bar is not None and not self._n_waiting:
                    self._bar.close()
                    self._bar = None

    def _count(self):
        with self._lock:
            self._n_built += 1
            if self._n_built == 1 and is_watched():
                print(f"compiling kernels for {self.device}, once", file=sys.stderr, flush=True)
            if self._bar is not None:
                self._bar.update()


def compile_beside(device):
    """Starts a process that compiles products while this one tests a device at its first use.

    PoCL compiles one program at a time in a process, but processes share its cache. The self-test
    compiles four products; those of turned operators and of sources' boxes are in the cache soon
    after. The process ends by itself, prints nothing, and does no harm if it fails.

    device: a Device; nothing is done for other platforms than PoCL, or without a second core
    """
    if device.platform != PLATFORM or device.kind != "CPU":
        return
    if n_host_cores() < 2 or not sys.executable:
        return
    module = f"{__package__}.prebuild"
    command = [sys.executable, "-m", module, f"{device.platform}:{device.name}"]
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    with suppress(OSError):
        process = subprocess.Popen(command, **quiet)
        threading.Thread(target=process.wait, daemon=True).start()
