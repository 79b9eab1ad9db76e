"""Memory of a process and all that it has started, watched while they run."""

from __future__ import annotations

import threading
import time
from pathlib import Path

# [s] between two looks: what comes and goes faster is missed. A look takes some 10 ms a process, in
# which that process gets no new memory: with four a second two workers were 1.78 times as fast as
# one, with one a second 1.87 times.
LOOK_S = 1.0


class TreeMemory(threading.Thread):
    """Watches the memory of a process and all its descendants.

    peak [bytes]: largest sum over all of them; largest [bytes]: of one process; both 0 if the
        system does not report memory
    spent_s [s]: processor time of watching

    Proportional set size: pages that several processes share are counted once in all.
    """

    def __init__(self, pid):
        super().__init__(daemon=True)
        self.pid, self.peak, self.largest, self.over = pid, 0, 0, threading.Event()
        self.spent_s = 0.0

    def run(self):
        while not self.over.wait(LOOK_S):
            sizes = [proportional(pid) for pid in tree(self.pid)]
            self.peak, self.largest = max(self.peak, sum(sizes)), max(self.largest, *sizes)
            self.spent_s = time.thread_time()

    def stop(self):
        """Ends the watch; returns the peak [bytes]."""
        self.over.set()
        self.join()
        return self.peak


def tree(pid):
    """A process and all its descendants that live."""
    found = [pid]
    for one in found:
        found += children(one)
    return found


def children(pid):
    """Processes that a process has started and that live."""
    try:
        return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def proportional(pid):
    """Proportional set size [bytes] of a process; 0 of one that has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:")), 0)
