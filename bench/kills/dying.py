"""`clresample` that ends during its writing, at a moment that is chosen beforehand.

    python -m bench.kills.dying LOG FOLDER MOMENT N_BYTES COMMAND ...

A moment is what the process is about to do in the folder: to open a file that it writes, to move,
link or remove one, to make or remove a folder; they are counted from 1, and LOG gets a line each.
At the given one (0: none) the process kills itself with SIGKILL, or, where N_BYTES is not 0, is
ended by the system as the next file that it writes reaches so many bytes: no code of it runs after.
"""

from __future__ import annotations

import os
import resource
import signal
import sys

PATH_OF = dict.fromkeys(("open", "os.mkdir", "os.rmdir", "os.remove", "shutil.rmtree"), 0)
PATH_OF |= {"os.rename": 1, "os.link": 1}  # which of an event's values is the path that changes


def watch(log, folder, moment, n_bytes):
    """Counts moments from now on, in Python's audit events; dies at the given one."""
    seen, inside = 0, os.path.join(os.path.realpath(folder), "")
    lines = open(log, "a", buffering=1)  # noqa: SIM115 - open until the process ends

    def hook(event, values):
        nonlocal seen
        if seen == moment > 0 or event not in PATH_OF:
            return
        if not isinstance(values[PATH_OF[event]], (str, os.PathLike)):
            return
        path = os.path.abspath(values[PATH_OF[event]])
        if not path.startswith(inside):
            return
        if event == "open" and not values[2] & (os.O_WRONLY | os.O_RDWR):
            return
        seen += 1
        lines.write(f"{event} {path.removeprefix(inside)}\n")
        if seen == moment:
            if not n_bytes:
                os.kill(os.getpid(), signal.SIGKILL)
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))
            lines.close()  # no bytes of its own: the next to write is the command

    sys.addaudithook(hook)


if __name__ == "__main__":
    watch(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    from clresample.cli import main

    sys.exit(main(sys.argv[5:]))
