"""Locks by which processes that need the same program compile it once."""

from __future__ import annotations

import functools
import hashlib
import threading
import time
from contextlib import contextmanager, suppress

from .device_cache import cache_folder

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FILE = "compiling.lock"
# [s] A process waits this long for another one; then it compiles the program itself.
MAX_WAIT_S = 30.0
POLL_S = 0.005
OFFSET_BITS = 62  # of a byte's place in a file

_OPENING = threading.Lock()


@contextmanager
def build_lock(program):
    """Excludes other processes of this user that compile the same program.

    A program is locked by one byte of a file in the cache folder, which stays empty. The system
    frees it when the process ends. Threads of one process do not exclude each other. Without such
    locks, as on Windows and in folders that cannot be written, nothing is excluded.

    program: text that identifies it and its device
    """
    digest = hashlib.sha256(program.encode()).digest()
    place = int.from_bytes(digest[:8], "big") >> (64 - OFFSET_BITS)
    with _OPENING:
        file = _lock_file(cache_folder() / FILE)
    is_held = file is not None and _acquire(file, place)
    try:
        yield
    finally:
        if is_held:
            with suppress(OSError):  # the file system has lost its locks
                fcntl.lockf(file, fcntl.LOCK_UN, 1, place)


@functools.cache  # closing any file of the same name would free all locks of the process
def _lock_file(path):
    """The open file, or None."""
    if fcntl is None:
        return None
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("ab")
    return None


def _acquire(file, place):
    """Locks a byte; returns False if that is impossible or takes over MAX_WAIT_S."""
    end = time.monotonic() + MAX_WAIT_S
    while time.monotonic() < end:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
            return True
        except BlockingIOError:
            time.sleep(POLL_S)
        except OSError:  # a file system without locks
            return False
    return False
