"""The command `clresample` and the demonstration. Imports all packages; none imports it.

`clresample --help` and a run's first line must appear at once, but NumPy, astropy, pyopencl and
matplotlib take a tenth to half a second each to import. So the command's modules import inside the
functions that need the import. The demonstration and the example are imported only when they run,
and have their imports at the top.
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
