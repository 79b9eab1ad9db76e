"""Reports that kernels are being compiled: a wait of seconds that happens once."""

from __future__ import annotations

import sys
import threading
import time

# [s] Processor time of a build: 0.02 from PoCL's or pyopencl's cache, 0.08 and more from source.
MAX_CACHED_S = 0.04


class CompilationNotice:
    """Prints one line at the first build that no cache had, in terminals and notebooks.

    device: name of the device
    """

    def __init__(self, device):
        self.device, self._lock, self._is_said = device, threading.Lock(), False

    def build(self, build):
        """Returns `build()`, and reports if it took longer than a cached build."""
        began = time.thread_time()
        built = build()
        if time.thread_time() - began > MAX_CACHED_S:
            self._say()
        return built

    def _say(self):
        with self._lock:
            is_first, self._is_said = not self._is_said, True
        if is_first and (sys.stderr.isatty() or "ipykernel" in sys.modules):
            print(f"compiling kernels for {self.device}, once", file=sys.stderr, flush=True)
