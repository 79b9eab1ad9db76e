"""The command `clresample` and the demonstration. Imports every room; nothing imports it.

`clresample --help` and a run's first line must appear at once, while NumPy, astropy, pyopencl and
matplotlib take a tenth to half a second each. So the modules of the command import what they run
inside the functions that run it. The demonstration and the example are themselves imported when
they run, and have their imports at the top.
"""

import sys

__all__ = ["main"]


def main(argv=None):
    """Runs `clresample` with these arguments (None: sys.argv's); returns the exit status."""
    try:
        from .command import main as run
    except KeyboardInterrupt:  # Ctrl-C ends the imports too in one line
        print("clresample: interrupted", file=sys.stderr)
        return 130
    return run(argv)
