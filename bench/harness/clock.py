"""Time on one thread: environment, calls by turns, worker processes."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm

from clresample import get_device

# Calls of a fast function for each call of the slowest.  Its median is then one of many, yet a
# round stays short: a machine that slows down meanwhile slows all functions of the round alike.
MAX_REPEATS = 20


# What libraries read when they are loaded: one thread each beside OpenCL's.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def on_one_thread():
    """Starts this command anew with one thread for each side, unless it was started so.

    NumPy's and FFT libraries read these variables when they are loaded.  PoCL's simplest device
    runs kernels in the calling thread: "basic", called "cpu-minimal" from version 4 on.  GalSim
    draws on one thread by default.

    returns the variables as text, for the record
    """
    pocl = re.search(r"pocl (\d+)", get_device().cl.platform.version, re.IGNORECASE)
    return _start_with(
        ONE_THREAD
        | {
            "POCL_DEVICES": "basic" if pocl is None or int(pocl[1]) < 4 else "cpu-minimal",
            "CL_CONFIG_CPU_TBB_NUM_WORKERS": "1",  # Intel's CPU runtime
        }
    )


def on_all_cores():
    """Starts this command anew with OpenCL on all cores, as a user has it, and the rest on one.

    On matrices as small as a fit's, threads of NumPy's libraries wait for each other and OpenCL's.
    """
    return _start_with(ONE_THREAD) + ", OpenCL on all cores"


def _start_with(wanted):
    """Starts this command anew under these variables, unless it has them; returns them as text."""
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        command = [sys.executable, *sys.orig_argv[1:]]
        os.execve(sys.executable, command, {**os.environ, **wanted})
    return " ".join(f"{name}={value}" for name, value in wanted.items())


def in_processes(function, tasks, n_processes, size_of=None, initial=0, unit="scenes"):
    """Pairs (task, function(*task)) in the order in which worker processes finish them.

    n_processes: 1 is this process alone
    size_of: how many scenes a task has, for a bar of progress; initial: how many were done before
    """
    sizes = [size_of(task) if size_of else 1 for task in tasks]
    no_bar = None if size_of else True  # None: none where the output is no terminal
    bar = tqdm(total=initial + sum(sizes), initial=initial, unit=f" {unit}", disable=no_bar)
    with bar, contextlib.ExitStack() as stack:
        if n_processes == 1:
            done = ((i, function(*task)) for i, task in enumerate(tasks))
        else:
            pool = ProcessPoolExecutor(n_processes, mp_context=get_context("spawn"))
            stack.callback(pool.shutdown, cancel_futures=True)
            futures = {pool.submit(function, *task): i for i, task in enumerate(tasks)}
            done = ((futures[future], future.result()) for future in as_completed(futures))
        for i, found in done:
            yield tasks[i], found
            bar.update(sizes[i])


def in_chunks(seeds, n):
    """Ranges of at most n seeds, which together are all."""
    return [seeds[i : i + n] for i in range(0, len(seeds), n)]


def interleaved_ms(functions, *, seconds, least=5, timer=time.perf_counter):
    """Median time [ms] of one call of each function, all called in turn for `seconds`.

    functions: name -> callable.  Each is called twice before, to compile and allocate and to see
        how long it takes.  In a round the fast ones are called several times; what disturbs the
        machine disturbs them all alike.
    least: calls of each function, even where they take longer than `seconds`
    timer: what a call's time is taken by; time.process_time counts this process alone
    """
    for function in functions.values():
        function()
    once = {name: _seconds(function, timer) for name, function in functions.items()}
    slowest = max(once.values())
    times = {name: [] for name in functions}
    end = time.perf_counter() + seconds
    while min(map(len, times.values())) < least or time.perf_counter() < end:
        for name, function in functions.items():
            for _ in range(max(1, min(MAX_REPEATS, int(slowest / once[name])))):
                times[name].append(_seconds(function, timer))
    return {name: float(np.median(t)) * 1e3 for name, t in times.items()}


def _seconds(function, timer):
    start = timer()
    function()
    return timer() - start
