"""Limits of a worker process: threads and memory."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys

from ..host import n_host_cores

PR_SET_PDEATHSIG = 1  # of prctl(2)


def thread_environment(n_workers) -> dict:
    """Environment of a worker, one of a number that share this machine's processor.

    NumPy's libraries get one thread, PoCL's CPU device its fraction of all threads, by the
    variables of its older and newer versions.
    """
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if n_workers > 1:
        n_threads = max(1, n_host_cores() // n_workers)
        names = "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"
        environment |= dict.fromkeys(names, str(n_threads))
    return environment


def limit_memory(bound):
    """Limits this process's private memory [bytes], if the system can.

    An allocation beyond it raises MemoryError or DeviceError; the fits of the group are then run
    one by one. Mapped files do not count (RLIMIT_DATA of Linux).
    """
    if bound is None or not sys.platform.startswith("linux"):
        return
    import resource

    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    if most == resource.RLIM_INFINITY or bound < most:
        resource.setrlimit(resource.RLIMIT_DATA, (int(bound), most))


def trim_memory():
    """Returns free memory to the system, if the C library can (glibc).

    Operators are in reference cycles, so that only the garbage collector frees them. Python runs it
    by the number of objects, not by their size: the pieces of an oversized blend left 0.1 to 0.3 GB
    a group, 2 GB in all, before it ran. The C library keeps most of the freed memory in fragments
    that the next task's arrays may not fit into: after sixteen groups it held 1.7 GB, of which
    0.25 GB were in use.
    """
    gc.collect()
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # a C library without it
            ctypes.CDLL(None).malloc_trim(0)


def die_with_parent(parent):
    """Makes the system end this process when its parent is killed, if it can (Linux).

    On other systems it ends after its task. Until then it uses memory beside a resumed run, and
    writes a file of results that the resumed run writes too.
    """
    if not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):  # a C library without prctl
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:  # it was killed before
        os._exit(1)
