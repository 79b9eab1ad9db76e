"""Tasks of worker processes, in a module that imports little: each process imports it."""

import os
import signal
import time
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from clresample.device.discovery import DeviceError


def work(folder, task):
    """Tasks as words: what a worker may do."""
    Path(folder, f"{task}-{time.monotonic_ns()}").touch()
    if task == "raise":
        raise ValueError("a bad blend")
    if task == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "die once" and len(list(Path(folder).glob("die once-*"))) < 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "hang":
        time.sleep(600)
    return task.upper()


@dataclass(frozen=True)
class Folder:
    """Context of tasks in three steps, of which each leaves a file."""

    folder: str
    device: object = None


def nothing(context, task):
    """Inputs of a task that needs none."""


def act(context, task, given):
    """`work`, and the content of its file."""
    return work(context.folder, task), task.encode()


def path_of(context, task):
    return Path(context.folder) / f"{task}.txt"


def whose(folder, task):
    """Number of the process that has it."""
    return os.getpid()


def on_device(device, task):
    """A worker whose device is gone raises; the others work."""
    time.sleep(0.2)
    if device == "gone":
        raise DeviceError(f"{device} no longer answers")
    return device


def take(megabytes, task):
    """Private memory of that size, written."""
    return len(bytearray(task << 20))


class Itself:
    """A large array in an object that refers to itself, as operators do."""

    def __init__(self, n_bytes):
        self.array, self.itself = np.ones(n_bytes, np.uint8), self


class Shared(Itself):
    """Context that the tasks of a stage share; a process holds those present."""

    there: ClassVar = weakref.WeakSet()

    def __init__(self):
        super().__init__(1)

    def __setstate__(self, state):
        vars(self).update(state)
        self.there.add(self)


def shared_there(shared, task):
    """Number of contexts of this and earlier stages the worker holds."""
    return len(Shared.there)


def held_before(n_bytes, task):
    """Memory [bytes] of the worker when it begins; it leaves an Itself behind."""
    if not isinstance(task, int):
        raise ValueError(f"{task} leaves {Itself(n_bytes).array.size} bytes too")
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    Itself(n_bytes)
    return pages * os.sysconf("SC_PAGE_SIZE")


def name_of_process(context, task):
    time.sleep(0.2)
    return os.getpid(), context


def say_and_sleep(folder, task):
    Path(folder, "pid").write_text(str(os.getpid()))
    time.sleep(600)
