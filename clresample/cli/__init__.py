"""The command `clresample` and the demonstration. Imports every room; nothing imports it.

`clresample --help` and a run's first line must appear at once, while NumPy, astropy, pyopencl and
matplotlib take a tenth to half a second each. So the modules of the command import what they run
inside the functions that run it. The demonstration and the example are themselves imported when
they run, and have their imports at the top.
"""

from .command import main

__all__ = ["main"]
